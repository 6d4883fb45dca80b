"""The blueprint: a page per question."""

from __future__ import annotations

from typing import TYPE_CHECKING

from copem_replay.viewer import pages
from copem_replay.viewer.pages import Content
from copem_replay.viewer.sink import ELAPSED, digest, ns

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun.blueprint as rrb

LAYOUT = 4
"""Counts up when the blueprint changes: the viewer keeps one per application id and prefers what it has."""
ALL_VIEWS = 3.1
"""How much wider than high all views together are (chosen)."""


def blueprint(of: Content) -> tuple[rrb.Blueprint, str]:
    """All pages; and a digest of all that they depend on."""
    import rerun.blueprint as rrb

    scene = of.replay.scene
    made = [pages.overview(of)]
    if of.objects:
        made += [pages.who_knew_when(of), pages.why_not_earlier(of)]
    made += [pages.what_each_believes(of), pages.how_far_off(of)]
    if any(of.heard(name) for name in of.configurations):
        made.append(pages.where_units_are(of))
    made.append(pages.in_words())
    onset_ns = int(ns(of.table["onset_s"].min())) if len(of.table) else 0
    end_ns = max(scene.end_ns - scene.t0_ns, onset_ns)
    # No blueprint can place the time cursor, but playing begins where the selection does: at the first onset.
    panel = rrb.TimePanel(
        timeline=ELAPSED,
        play_state="paused",
        loop_mode="selection",
        state="collapsed",
        time_selection=rrb.components.AbsoluteTimeRange(onset_ns, end_ns),
    )
    whole = rrb.Blueprint(
        rrb.Tabs(*made, active_tab=0),
        panel,
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )
    eyes = [(eye.place_m.tolist(), eye.target_m.tolist(), eye.object_ix) for eye in (of.eye, *of.eyes, of.above)]
    parts = (
        LAYOUT,
        list(of.configurations),
        [of.heard(name) for name in of.configurations],
        [scene.object_ids[k] for k in of.objects],
        eyes,
        [of.axes_s[k] for k in of.objects],
        list(of.named),
        onset_ns,
        end_ns,
        of.baseline,
        *([under] if any(under := [of.under(k) for k in of.objects]) else []),
    )
    return whole, digest(repr(parts))


def aspect(views: int) -> float:
    """How much wider than high each of so many views is."""
    across = pages.columns(views)
    return ALL_VIEWS * -(-views // across) / across
