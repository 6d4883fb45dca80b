"""Lanes: what each shown object is to each configuration over time, changes too short to follow left out.

An entity per object and configuration, `lanes/6_pedestrian/2_PEM`; its number is its place among those of the file. A
white mark ends at the onset. Nothing is said while the object is absent. Known begins at `detection_s`, to the
nanosecond, whatever is left out around it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from copem_replay.core.colours import Rgb
from copem_replay.core.tracks import TRUTH, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.viewer.palette import ONSET, status_colour
from copem_replay.viewer.reasons import body_name, lane_text
from copem_replay.viewer.sink import Out, lane_path, short_ids
from copem_replay.viewer.statuses import ABSENT, HIDDEN, KNOWN

if TYPE_CHECKING:
    from copem_replay.viewer.line_of_sight import Sight
    from copem_replay.viewer.status import Clock, Status

STEADY_S = 0.4
"""What lasts less than this is told with what is around it (chosen: shorter words are not read)."""
MARK = 1 / 80
"""How long the mark is that ends at the onset, as a share of the axis (chosen: it is seen)."""
ONSET_IS = "onset"
_STEADY_NS = round(STEADY_S * 1e9)


@dataclass(frozen=True)
class Span:
    """The status in the instants from `first` to before `end`, for the most part."""

    first: int
    end: int
    status: int


def lanes(
    out: Out, scene: Scene, experiment: Experiment, seen: Sight, made: Mapping[str, Status],
    colours: Mapping[str, Rgb], clocks: Mapping[str, Clock], axes: Mapping[int, tuple[float, float]],
) -> None:  # fmt: skip
    """Of each shown object a lane per configuration, with a mark that ends at the onset. `axes`: from when to when each
    object is looked at (s).
    """
    import rerun as rr

    ids, units = short_ids(scene), [*experiment.units, TRUTH]
    for m, k in enumerate(seen.object_ix.tolist()):
        mark_ns = round((axes[k][1] - axes[k][0]) * MARK * 1e9)
        for place, (name, of) in enumerate(made.items()):
            if not len(of.elapsed_ns):
                continue
            spans = steady(of.elapsed_ns, of.status[:, m])
            texts = [_text(ids, units, seen, of, m, span) for span in spans]
            tints = [status_colour(span.status, colours[name]) if span.status else ONSET for span in spans]
            style = {text: tint for text, tint in zip(texts, tints, strict=True) if text} | {ONSET_IS: ONSET}
            begins = of.elapsed_ns[[span.first for span in spans]]
            elapsed, texts = _with_onset(begins, texts, int(clocks[name].onset_ns[k]), mark_ns)
            path = lane_path(scene, k, place, name)
            said = [text for text in texts if text is not None]  # while it is absent the row is empty
            states = rr.StateChange.columns(state=pa.array(said, pa.string()))
            out.columns(path, elapsed, states.partition(np.array([text is not None for text in texts], dtype=np.int64)))
            values = list(style)
            out.static(path, rr.StateConfiguration(values=values, labels=values, colors=list(style.values())))


def steady(elapsed_ns: Int, status: Int) -> list[Span]:
    """A status (K,) without what passes sooner than `STEADY_S`.

    Statuses that follow on each other faster are one span, of the one that lasts longest of all of them; what is too
    short even then goes on as what was before. The first time that the object is known is told, however short.
    """
    first = np.flatnonzero(np.diff(status, prepend=-1))
    what, lasts = status[first], np.diff(elapsed_ns[first], append=elapsed_ns[-1] + _STEADY_NS)
    told = lasts >= _STEADY_NS
    told[np.flatnonzero(what == KNOWN)[:1]] = True
    spans: list[Span] = []
    k = 0
    while k < len(first):
        end = k + 1
        if not told[k]:
            end = next((n for n in range(k, len(first)) if told[n]), len(first))
        of_each = np.bincount(what[k:end], weights=lasts[k:end])
        if told[k] or not spans or of_each.sum() >= _STEADY_NS:
            spans.append(Span(int(first[k]), len(status), int(of_each.argmax())))
        k = end
    kept = [span for n, span in enumerate(spans) if n == 0 or span.status != spans[n - 1].status]
    return [replace(span, end=after.first) for span, after in pairwise([*kept, Span(len(status), 0, 0)])]


def _text(ids: Sequence[str], units: Sequence[str], seen: Sight, of: Status, m: int, span: Span) -> str | None:
    """The text of a span: the unit, or what hides the object, for the most part of it."""
    if span.status == ABSENT:
        return None
    rows = np.arange(span.first, span.end)
    rows = rows[of.status[rows, m] == span.status]
    unit = of.unit_ix[rows, m]
    body = seen.body_ix[unit, np.maximum(of.frame[rows], 0), m] if span.status == HIDDEN else np.zeros_like(unit)
    pairs, count = np.unique(np.stack([unit, body]), axis=1, return_counts=True)
    by, what = pairs[:, count.argmax()].tolist()
    return lane_text(span.status, units[by], body_name(ids, seen.solids, what))


def _with_onset(
    elapsed_ns: Int, texts: Sequence[str | None], onset_ns: int, mark_ns: int
) -> tuple[Int, list[str | None]]:
    """A mark before the onset, and from there on what holds then; none where the log begins with it."""
    begin = onset_ns - mark_ns
    if not elapsed_ns[0] <= begin:
        return elapsed_ns, list(texts)
    before, after = int(np.searchsorted(elapsed_ns, begin)), int(np.searchsorted(elapsed_ns, onset_ns, side="right"))
    instants = np.concatenate([elapsed_ns[:before], [begin, onset_ns], elapsed_ns[after:]])
    return instants, [*texts[:before], ONSET_IS, texts[after - 1], *texts[after:]]
