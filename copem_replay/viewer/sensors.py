"""The experiment's units: where they are, and the fields of view of their PEMs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import Float, Tracks
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.perception.field_of_view import outlines
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.sensor_poses import UnitPoses, carrier, list_instants, mounting_height, unit_ground
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.palette import EGO, FIELD
from copem_replay.viewer.sink import Out, f32, upright

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

NAMED_UNITS = 6
"""So many units are named in the view of the units (chosen: no view has more labels)."""
APART_M, NAMED_WITHIN_M = 12.0, 110.0
"""Names lie on each other where units are nearer than the first; farther away than the second is out of the picture."""
FIELD_ALPHA = 10
"""How opaque the ground is in a field of view: where many see, it is brighter (chosen)."""

_ABOVE_GROUND_M = 0.05


def units(out: Out, replay: Replay, experiment: Experiment) -> None:
    """A point and a field of view for each unit; neither while its carrier is absent. Names only when selected."""
    import rerun as rr

    for name, unit in experiment.units.items():
        path = ["world", "units", name]
        mark = rr.Radius.ui_points(2)
        style = rr.Points3D.from_fields(colors=[EGO], radii=mark, labels=[name], show_labels=False)
        if unit.recorded is not None:
            stamps = replay.truth.stamp_ns if unit.on is not None else replay.truth.stamp_ns[:1]
            place = _recorded_place(replay, experiment, unit, (stamps - replay.scene.t0_ns) * np.float64(1e-9))
            there = ~np.isnan(place[:, 0])
            if there.any():
                columns = rr.Points3D.columns(positions=f32(*place[there].T)).partition(there.astype(np.int64))
                out.columns(path, stamps - replay.scene.t0_ns, columns)
                out.static(path, style)
            continue
        at = replay.placed.poses[name]
        place, there = f32(at.x_m, at.y_m, at.z_m), at.present
        elapsed_ns = list_instants(replay.scene, replay.truth, unit) - replay.scene.t0_ns
        if unit.at is not None:
            out.static(path, rr.Points3D.from_fields(positions=place[:1]))
        else:
            out.columns(path, elapsed_ns, rr.Points3D.columns(positions=place[there]).partition(there.astype(np.int64)))
        out.static(path, style)
        height_m = mounting_height(replay.scene, replay.truth, unit)
        _field(out, name, unit, at, elapsed_ns, experiment.pems[str(unit.pem)].couples, height_m)


def named_units(replay: Replay, experiment: Experiment, at_m: Float, time_s: float) -> dict[str, Float]:
    """Which units are named, and where they are then (3,): the ego's, then those nearest to a place, names apart."""
    place = {}
    for name in experiment.modelled:
        at = replay.placed.poses[name]
        stamp = replay.scene.t0_ns + round(time_s * 1e9)
        row = int(np.searchsorted(replay.placed.stamps_ns[name], stamp, side="right")) - 1
        if row >= 0 and at.present[row]:
            place[name] = np.array([at.x_m[row], at.y_m[row], at.z_m[row]])
    order = sorted(place, key=lambda name: (experiment.units[name].on != "ego", np.hypot(*(place[name] - at_m)[:2])))
    chosen: dict[str, Float] = {}
    for name in order:
        apart = (np.hypot(*(place[name] - other)[:2]) >= APART_M for other in chosen.values())
        if len(chosen) < NAMED_UNITS and np.hypot(*(place[name] - at_m)[:2]) <= NAMED_WITHIN_M and all(apart):
            chosen[name] = place[name]
    return chosen


def unit_places(replay: Replay, experiment: Experiment, heard: Tracks) -> Float:
    """(F, 3) where the unit of each list was at capture; NaN where that is not known, as of the truth."""
    place = np.full((len(heard.stamp_ns), 3), np.nan)
    for k, name in enumerate(heard.units):
        mine = np.flatnonzero(heard.frame_unit_ix == k)
        if name not in experiment.units or not len(mine):
            continue
        unit = experiment.units[name]
        if unit.recorded is not None:
            place[mine] = _recorded_place(replay, experiment, unit, heard.captured_s[mine])
            continue
        at = replay.placed.poses[name]
        row = np.searchsorted(list_instants(replay.scene, replay.truth, unit), heard.stamp_ns[mine])
        place[mine] = np.stack([at.x_m, at.y_m, at.z_m], axis=-1)[row]
    return place


def _recorded_place(replay: Replay, experiment: Experiment, unit: Unit, time_s: Float) -> Float:
    """(K, 3) where a unit is whose lists are recorded: on its carrier, or at its place, if it is given."""
    place = np.full((len(time_s), 3), np.nan)
    if unit.at is not None:
        ground_m = unit_ground(replay.truth, "", unit)
        place[:] = (*unit.at, ground_m + (unit.height_m or 0.0))
    elif unit.on is not None:
        on = np.full(len(time_s), carrier(replay.scene, unit))
        at, there = states_at(
            replay.truth, on, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
        )  # fmt: skip
        high_m = at["height_m"] / 2 if unit.height_m is None else unit.height_m - at["height_m"] / 2
        place[there] = np.stack([at["x_m"], at["y_m"], at["z_m"] + high_m], axis=-1)[there]
    return place


def _field(
    out: Out, name: str, unit: Unit, at: UnitPoses, elapsed_ns: np.ndarray, pem: tuple[Couple, ...], height_m: float
) -> None:
    """The outlines in the unit's own frame, which moves; on the ground under it."""
    import rerun as rr

    down_m = _ABOVE_GROUND_M - height_m
    strips = [f32(*line.T, np.full(len(line), down_m)) for line in outlines(pem)]
    if not strips or not at.present.any():
        return
    path, there = ["world", "fields", name], np.flatnonzero(at.present)
    place, turn = f32(at.x_m[there], at.y_m[there], at.z_m[there]), upright(at.heading_rad[there])
    if unit.at is not None:
        out.static(path, rr.Transform3D.from_fields(translation=place[0], quaternion=turn[0]))
        out.static(path, rr.LineStrips3D.from_fields(strips=strips), _ground(strips))
    else:
        out.columns(path, elapsed_ns[there], rr.Transform3D.columns(translation=place, quaternion=turn))
        # Without a transform it would be drawn at the origin: the outlines come and go with the carrier.
        changes = np.flatnonzero(np.diff(at.present, prepend=False))
        comes = at.present[changes]
        lines = rr.LineStrips3D.columns(strips=strips * int(comes.sum())).partition(len(strips) * comes)
        out.columns(path, elapsed_ns[changes], lines)
        if there.all() and len(there) == len(elapsed_ns):
            out.static(path, _ground(strips))
    out.static(path, rr.LineStrips3D.from_fields(colors=[FIELD], radii=rr.Radius.ui_points(0.75)))


def _ground(strips: Sequence[np.ndarray]) -> rr.Mesh3D:
    """What lies within the outermost outline, brightened a little: triangles from the unit to each piece of it."""
    import rerun as rr

    arc = max(strips, key=lambda line: float(np.hypot(*line[:, :2].T).max()))
    count = len(arc)
    middle = np.array([[0.0, 0.0, arc[0, 2]]], dtype=np.float32)
    edge = np.arange(count - 1)
    fan = np.stack([np.full(count - 1, count), edge, edge + 1], axis=-1)
    return rr.Mesh3D(
        vertex_positions=np.concatenate([arc, middle]), triangle_indices=fan, albedo_factor=(*FIELD, FIELD_ALPHA)
    )
