"""Marks that stay: where and when the clock of an object began, and where it was when it was first known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.colours import Rgb
from copem_replay.core.errors import ExperimentError
from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import SAME_INSTANT_NS, Float, Int
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.reference import Reference
from copem_replay.perception.sensor_poses import carrier
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.visibility_curves import BY_ANY, BY_EGO, Curve
from copem_replay.viewer.palette import ONSET
from copem_replay.viewer.sink import Out, entity_names, f32, ns, part_of, short_ids, table_rows
from copem_replay.viewer.text_panels import verdict_of

MARK_SIZE = 6.5
LINED = 3
"""With more marks than this they have no lines (chosen: they lie on each other)."""


def onsets(out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, shown: Sequence[int]) -> None:
    """“onset 2” where the object then was."""
    part = _of(replay, table, shown).drop_duplicates("object_id")
    texts = [f"onset {short_ids(replay.scene)[replay.scene.object_number[name]]}" for name in part["object_id"]]
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
    )


def detections(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, name: str, shown: Sequence[int], colour: Rgb
) -> None:
    """Where the object truly was when the configuration `name` first knew it, and a line there from the ego.

    “2 detected +0.90 s, 13.5 m, stops” is told of its middle: its length is the distance at detection.
    """
    part = _of(replay, table, shown)
    part = part[(part["configuration"] == name) & part["detected"]]
    path = ["world", part_of(name), "marks"]
    reference = replay.truth_cache.reference
    order = np.argsort(part["detection_s"].to_numpy(), kind="stable")
    part = part.iloc[order]
    told = [
        _told(episode, short_ids(replay.scene)[replay.scene.object_number[episode.object_id]])
        for episode in table_rows(part)
    ]
    try:
        at = reference(part["detection_s"].to_numpy(dtype=float))
    except ExperimentError:  # no distances are measured
        at = None
    _stay(out, path, replay, experiment, part, "detection_s", [""] * len(part) if at else told, colour, up=1)
    if at is not None:
        _from_reference(out, [*path, "from"], replay, experiment, part, at, told, colour)


def _from_reference(
    out: Out, path: list[str], replay: Replay, experiment: Experiment, part: pd.DataFrame, at: Reference,
    texts: Sequence[str], colour: Rgb,
) -> None:  # fmt: skip
    """Lines on the ground from the reference to the objects at detection, and what is said of each in its middle."""
    import rerun as rr

    object_ix = part["object_id"].map(replay.scene.object_number).to_numpy(dtype=np.int64)
    time_s = part["detection_s"].to_numpy(dtype=float)
    to, there = states_at(replay.truth, object_ix, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s)
    kept = np.flatnonzero(there & at.present)
    ground = to["z_m"] - to["height_m"] / 2
    ends = [f32(x[kept], y[kept], ground[kept]) for x, y in ((at.x_m, at.y_m), (to["x_m"], to["y_m"]))]
    instants, last = np.unique(ns(time_s[kept])[::-1], return_index=True)
    counts = len(kept) - last
    _, mark = np.nonzero(np.arange(len(kept)) < counts[:, None])
    lines = np.stack(ends, axis=1)[mark]
    if len(kept) <= LINED:
        out.columns([*path, "line"], instants, rr.LineStrips3D.columns(strips=lines).partition(counts))
        out.static([*path, "line"], rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(1.0)))
    words = pa.array(texts, pa.string()).take(pa.array(kept[mark]))
    out.columns(path, instants, rr.Points3D.columns(positions=lines.mean(axis=1), labels=words).partition(counts))
    small = rr.Radius.ui_points(1)
    out.static(path, rr.Points3D.from_fields(colors=[colour], radii=small, show_labels=False))


def _of(replay: Replay, table: pd.DataFrame, shown: Sequence[int]) -> pd.DataFrame:
    return table[table["object_id"].isin([replay.scene.object_ids[k] for k in shown])]


def _told(episode: Any, name: str) -> str:
    parts = [f"{name} detected {episode.time_to_detection_s:+.2f} s"]
    if not np.isnan(episode.distance_at_detection_m):
        parts.append(f"{episode.distance_at_detection_m:.1f} m")
    if (verdict := verdict_of(episode)) is not None:
        parts.append(verdict)
    return ", ".join(parts)


def _stay(
    out: Out, path: list[str], replay: Replay, experiment: Experiment, part: pd.DataFrame, when: str,
    texts: Sequence[str], colour: Rgb, *, up: int,
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
    size = rr.Radius.ui_points(3)
    out.static(path, rr.Points3D.from_fields(colors=[colour], radii=size, show_labels=False))


def on_curves(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, name: str, curves: Mapping[str, Curve],
    colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """The same instants on the curves of the object `name`: a detection on the curve of its units.

    An entity has one colour at an instant: marks of the same one are on several, smaller ones on larger ones. One per
    configuration would cost more than all curves.
    """
    import rerun as rr

    if not curves:
        return
    entity = entity_names(replay.scene)[replay.scene.object_number[name]]
    episodes = table[table["object_id"] == name]
    marks = [(BY_EGO, episodes["onset_s"].head(1), ONSET, rr.components.MarkerShape.Diamond)]
    for configuration, colour in colours.items():
        mine = episodes[(episodes["configuration"] == configuration) & episodes["detected"]]
        curve = BY_EGO if _only_ego(replay, experiment, configuration) else BY_ANY
        marks.append((curve, mine["detection_s"], colour, rr.components.MarkerShape.Circle))
    rows: list[tuple[int, float, Rgb, Any]] = []
    for curve, time_s, colour, shape in marks:
        known_ns, heights = _on(curves.get(curve, curves[BY_ANY]), ns(time_s))
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
        path = ["plots", "visible_share", entity, f"mark_{k + 1}"]
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
