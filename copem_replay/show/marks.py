"""Marks that stay: where and when the clock of an object began, and where it was when it was first known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.colours import Rgb
from copem_replay.experiment import Experiment
from copem_replay.replay import Replay
from copem_replay.resample import states_at
from copem_replay.show.out import Out, f32, ns, part_of
from copem_replay.show.plots import BY_ANY, BY_EGO, Curve
from copem_replay.tracks import SAME_INSTANT_NS, Float, Int
from copem_replay.units import carrier

ONSET: Rgb = (255, 130, 220)
MARK_SIZE = 6.5
NAMED_ONSETS = 3
"""With more of them than this their names are not shown (chosen: most lie under a detection's)."""


def onsets(out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, shown: Sequence[int]) -> None:
    """“onset 2” where the object then was."""
    part = _of(replay, table, shown).drop_duplicates("object_id")
    texts = [f"onset {name}" for name in part["object_id"]]
    _stay(
        out,
        ["world", "truth", "onsets"],
        replay,
        experiment,
        part,
        "onset_s",
        texts,
        ONSET,
        up=-1,
        named=len(texts) <= NAMED_ONSETS,
    )


def detections(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, name: str, shown: Sequence[int], colour: Rgb
) -> None:
    """“2 detected +0.90 s, 13.5 m” where the object then truly was, for the configuration `name`."""
    part = _of(replay, table, shown)
    part = part[(part["configuration"] == name) & part["detected"]]
    texts = [_told(look) for look in part.itertuples()]
    _stay(out, ["world", part_of(name), "marks"], replay, experiment, part, "detection_s", texts, colour, up=1)


def _of(replay: Replay, table: pd.DataFrame, shown: Sequence[int]) -> pd.DataFrame:
    return table[table["object_id"].isin([replay.scene.object_ids[k] for k in shown])]


def _told(look: Any) -> str:
    far_m = look.distance_at_detection_m
    return f"{look.object_id} detected {look.time_to_detection_s:+.2f} s" + (
        "" if np.isnan(far_m) else f", {far_m:.1f} m"
    )


def _stay(
    out: Out, path: list[str], replay: Replay, experiment: Experiment, part: pd.DataFrame, when: str,
    texts: Sequence[str], colour: Rgb, *, up: int, named: bool = True,
) -> None:  # fmt: skip
    """A point per row of `part`, on the object at the instant `when`: each row of the entity has all until then."""
    import rerun as rr

    order = np.argsort(part[when].to_numpy(), kind="stable")
    object_ix = part["object_id"].map(replay.scene.object_number).to_numpy(dtype=np.int64)[order]
    time_s = part[when].to_numpy()[order]
    at, there = states_at(
        replay.truth, object_ix, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
    )  # fmt: skip
    place = f32(at["x_m"], at["y_m"], at["z_m"] + up * at["height_m"] / 2)[there]
    words = pa.array(texts, pa.string()).take(pa.array(order[there]))
    instants, last = np.unique(ns(time_s[there])[::-1], return_index=True)
    counts = len(place) - last  # how many by then: the place of each instant's last mark, from the end
    _, mark = np.nonzero(np.arange(len(place)) < counts[:, None])
    columns = rr.Points3D.columns(positions=place[mark], labels=words.take(pa.array(mark)))
    out.columns(path, instants, columns.partition(counts))
    size = rr.Radius.ui_points(5)
    out.static(path, rr.Points3D.from_fields(colors=[colour], radii=size, show_labels=named))


def on_curves(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, name: str, curves: Mapping[str, Curve],
    colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """The same instants on the curves of the object `name`: a detection on the curve of those who made it.

    An entity has one colour at an instant: marks of the same one are on several, smaller ones on larger ones. One per
    configuration would cost more than all curves.
    """
    import rerun as rr

    if not curves:
        return
    looks = table[table["object_id"] == name]
    marks = [(BY_EGO, looks["onset_s"].head(1), ONSET, rr.components.MarkerShape.Diamond)]
    for configuration, colour in colours.items():
        mine = looks[(looks["configuration"] == configuration) & looks["detected"]]
        whose = BY_EGO if _only_ego(replay, experiment, configuration) else BY_ANY
        marks.append((whose, mine["detection_s"], colour, rr.components.MarkerShape.Circle))
    rows: list[tuple[int, float, Rgb, Any]] = []
    for whose, time_s, colour, shape in marks:
        known_ns, heights = _on(curves.get(whose, curves[BY_ANY]), ns(time_s))
        rows += [(at, height, colour, shape) for at, height in zip(known_ns.tolist(), heights.tolist(), strict=True)]
    if not rows:
        return
    at, share, rgb, shapes = (list(column) for column in zip(*sorted(rows, key=lambda row: row[0]), strict=True))
    instants = np.array(at)
    layer = np.arange(len(rows)) - np.searchsorted(instants, instants)
    spots = np.array(share)
    under = np.tril((instants[:, None] == instants) & (spots[:, None] == spots), -1).sum(axis=1)
    for k in range(layer.max() + 1):
        mine = np.flatnonzero(layer == k)
        style = rr.SeriesPoints.columns(
            colors=np.array(rgb, dtype=np.uint8)[mine],
            markers=[shapes[m] for m in mine],
            marker_sizes=MARK_SIZE * 0.6 ** under[mine],
        )
        path = ["plots", "visible_share", name, f"mark {k + 1}"]
        out.columns(path, instants[mine], [*rr.Scalars.columns(scalars=spots[mine]), *style])


def _on(curve: Curve, instants: Int) -> tuple[Int, Float]:
    """The instants (K,) at which the curve is known, and its newest share."""
    row = np.searchsorted(curve.elapsed_ns, instants + SAME_INSTANT_NS, side="right") - 1
    share = np.append(curve.share, np.nan)[row]  # −1, the one more: there was none yet
    known = ~np.isnan(share)
    return instants[known], share[known]


def _only_ego(replay: Replay, experiment: Experiment, configuration: str) -> bool:
    heard = experiment.units_of(experiment.configurations[configuration])
    carriers = [carrier(replay.scene, experiment.units[unit]) for unit in heard]
    return bool(carriers) and all(on == replay.scene.ego_ix for on in carriers)
