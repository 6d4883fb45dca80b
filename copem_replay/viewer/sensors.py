"""Units in the scene: their places, the fields of view of their PEMs, their ghosts and outages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import Bool, Float, Int, Tracks, UnitFaults
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.sensor_poses import (
    UnitPoses,
    couple_outlines,
    find_carrier,
    list_instants,
    mounting_height,
    unit_ground,
)
from copem_replay.pipeline.expansion import give_views
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.status import to_nanoseconds
from copem_replay.viewer.sink import EGO, FIELD, RecordingSink, stack_float32

if TYPE_CHECKING:
    import rerun as rr


NAMED_UNITS = 6
"""Most units with names in the view of the units: more labels cover it."""
APART_M, NAMED_WITHIN_M = 12.0, 110.0
"""Names overlap where units are nearer than the first; units farther away than the second are out of the picture."""
MARK_POINTS = 4.0
"""Radius of a unit's point: larger than that of a word, so that a unit is found."""
FIELD_ALPHA = 10
"""Opacity of a field of view on the ground, of 255: low, because the fields of many units add up."""

_ABOVE_GROUND_M = 0.05  # outlines are clear of the grid


def write_units(out: RecordingSink, replay: Replay, experiment: Experiment) -> None:
    """A point and a field of view for each unit; neither while its carrier is absent. Names show on selection."""
    import rerun as rr

    experiment = give_views(experiment)
    for name, unit in experiment.units.items():
        path = ["world", "units", name]
        mark = rr.Radius.ui_points(MARK_POINTS)
        style = rr.Points3D.from_fields(colors=[EGO], radii=mark, labels=[name], show_labels=False)
        if unit.pem is None:
            stamps = replay.truth.stamp_ns if unit.on is not None else replay.truth.stamp_ns[:1]
            place = _locate_recorded_unit(replay, experiment, unit, (stamps - replay.scene.t0_ns) * np.float64(1e-9))
            present = ~np.isnan(place[:, 0])
            if present.any():
                columns = rr.Points3D.columns(positions=stack_float32(*place[present].T)).partition(
                    present.astype(np.int64)
                )
                out.columns(path, stamps - replay.scene.t0_ns, columns)
                out.static(path, style)
            continue
        poses = replay.placed.poses[name]
        place, present = stack_float32(poses.x_m, poses.y_m, poses.z_m), poses.present
        elapsed_ns = list_instants(replay.scene, replay.truth, unit) - replay.scene.t0_ns
        if unit.at is not None:
            out.static(path, rr.Points3D.from_fields(positions=place[:1]))
        else:
            out.columns(
                path, elapsed_ns, rr.Points3D.columns(positions=place[present]).partition(present.astype(np.int64))
            )
        out.static(path, style)
        height_m = mounting_height(replay.scene, replay.truth, unit)
        _write_field(out, name, unit, poses, elapsed_ns, experiment.pems[str(unit.pem)].couples, height_m)


def choose_named_units(replay: Replay, experiment: Experiment, at_m: Float, time_s: float) -> dict[str, Float]:
    """Names and places (3,) of the units to be named: the ego's, then those nearest to `at_m`, none `APART_M` near.

    A recorded unit has a name if the experiment says where it is.
    """
    all_places = {name: locate_unit(replay, experiment, name, np.array([time_s]))[0] for name in experiment.units}
    place = {name: at for name, at in all_places.items() if not np.isnan(at[0])}
    order = sorted(place, key=lambda name: (experiment.units[name].on != "ego", np.hypot(*(place[name] - at_m)[:2])))
    named: dict[str, Float] = {}
    for name in order:
        apart = (np.hypot(*(place[name] - other)[:2]) >= APART_M for other in named.values())
        if len(named) < NAMED_UNITS and np.hypot(*(place[name] - at_m)[:2]) <= NAMED_WITHIN_M and all(apart):
            named[name] = place[name]
    return named


def locate_unit(replay: Replay, experiment: Experiment, name: str, time_s: Float) -> Float:
    """(K, 3) places of a unit at times (K,), s, as of its newest list; NaN: there is none, or it is not known where."""
    unit = experiment.units[name]
    if unit.fuses is not None:  # it is where its first member is
        return locate_unit(replay, experiment, unit.fuses[0], time_s)
    if unit.recorded is not None:
        return _locate_recorded_unit(replay, experiment, unit, time_s)
    poses, stamps_ns = replay.placed.poses[name], replay.placed.stamps_ns[name]
    row = np.searchsorted(stamps_ns, replay.scene.t0_ns + to_nanoseconds(time_s), side="right") - 1
    places = np.concatenate([stack_float32(poses.x_m, poses.y_m, poses.z_m), np.full((1, 3), np.nan)])
    return places[np.where((row >= 0) & np.append(poses.present, False)[row], row, -1)]


def unit_places(replay: Replay, experiment: Experiment, lists: Tracks) -> Float:
    """(F, 3) place of each list's unit at capture; NaN if unknown, and for lists of the truth."""
    place = np.full((len(lists.stamp_ns), 3), np.nan)
    for k, name in enumerate(lists.units):
        frames = np.flatnonzero(lists.frame_unit_ix == k)
        if name not in experiment.units or not len(frames):
            continue
        unit = experiment.units[name]
        if unit.pem is None:
            place[frames] = locate_unit(replay, experiment, name, lists.captured_s[frames])
            continue
        poses = replay.placed.poses[name]
        row = np.searchsorted(list_instants(replay.scene, replay.truth, unit), lists.stamp_ns[frames])
        place[frames] = np.stack([poses.x_m, poses.y_m, poses.z_m], axis=-1)[row]
    return place


def _locate_recorded_unit(replay: Replay, experiment: Experiment, unit: Unit, time_s: Float) -> Float:
    """(K, 3) place (m) of a recorded unit: where it is stated, or on its carrier; NaN: neither, or carrier absent."""
    place = np.full((len(time_s), 3), np.nan)
    if unit.at is not None:
        ground_m = unit_ground(replay.truth, "", unit)
        place[:] = (*unit.at, ground_m + (unit.height_m or 0.0))
    elif unit.on is not None:
        carrier_ix = np.full(len(time_s), find_carrier(replay.scene, unit))
        carrier, present = interpolate_states(
            replay.truth, carrier_ix, time_s, t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s
        )  # fmt: skip
        above_centre_m = carrier["height_m"] / 2 if unit.height_m is None else unit.height_m - carrier["height_m"] / 2
        place[present] = np.stack([carrier["x_m"], carrier["y_m"], carrier["z_m"] + above_centre_m], axis=-1)[present]
    return place


def _upright_quaternions(yaw_rad: Float) -> np.ndarray:
    """Quaternions xyzw (K, 4) of rotations about the vertical."""
    zero = np.zeros(len(yaw_rad))
    return stack_float32(zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2))


def _write_field(
    out: RecordingSink,
    name: str,
    unit: Unit,
    poses: UnitPoses,
    elapsed_ns: np.ndarray,
    pem: tuple[Couple, ...],
    height_m: float,
) -> None:
    """Write outlines of a unit's field of view on the ground, in the unit's moving frame, while it is present."""
    import rerun as rr

    ground_m = _ABOVE_GROUND_M - height_m
    strips = [stack_float32(*line.T, np.full(len(line), ground_m)) for line in couple_outlines(pem)]
    if not strips or not poses.present.any():
        return
    path, rows = ["world", "fields", name], np.flatnonzero(poses.present)
    place, turn = (
        stack_float32(poses.x_m[rows], poses.y_m[rows], poses.z_m[rows]),
        _upright_quaternions(poses.heading_rad[rows]),
    )
    if unit.at is not None:
        out.static(path, rr.Transform3D.from_fields(translation=place[0], quaternion=turn[0]))
        out.static(path, rr.LineStrips3D.from_fields(strips=strips), _field_mesh(strips))
    else:
        out.columns(path, elapsed_ns[rows], rr.Transform3D.columns(translation=place, quaternion=turn))
        # The outlines come and go with the carrier: without a transform they would be drawn at the origin.
        changes = np.flatnonzero(np.diff(poses.present, prepend=False))
        appears = poses.present[changes]
        lines = rr.LineStrips3D.columns(strips=strips * int(appears.sum())).partition(len(strips) * appears)
        out.columns(path, elapsed_ns[changes], lines)
        if rows.all() and len(rows) == len(elapsed_ns):
            out.static(path, _field_mesh(strips))
    out.static(path, rr.LineStrips3D.from_fields(colors=[FIELD], radii=rr.Radius.ui_points(0.75)))


def _field_mesh(strips: Sequence[np.ndarray]) -> rr.Mesh3D:
    """The area within the outermost outline: triangles from the unit to each piece of the line."""
    import rerun as rr

    outermost = max(strips, key=lambda line: float(np.hypot(*line[:, :2].T).max()))
    count = len(outermost)
    middle = np.array([[0.0, 0.0, outermost[0, 2]]], dtype=np.float32)
    edge = np.arange(count - 1)
    fan = np.stack([np.full(count - 1, count), edge, edge + 1], axis=-1)
    return rr.Mesh3D(
        vertex_positions=np.concatenate([outermost, middle]), triangle_indices=fan, albedo_factor=(*FIELD, FIELD_ALPHA)
    )


# Ghosts and outages.

FALSE: Rgb = (255, 90, 90)
"""Colour of ghosts and outages of every unit."""


class FaultsShown:
    """Writes ghosts and outages of the units of one run, time chunk by time chunk, each list once."""

    def __init__(self, out: RecordingSink, replay: Replay, experiment: Experiment) -> None:
        self._out, self._replay, self._experiment = out, replay, experiment
        self._shown_until_ns: dict[str, int] = {}

    def add(self, run_tracks: Mapping[str, FusedTracks]) -> None:
        """Write the faults of the next time chunk; `run_tracks`: fused tracks by configuration."""
        candidates = [fused_tracks for fused_tracks in run_tracks.values() if fused_tracks.faults is not None]
        if not candidates:
            return
        # Ideal fusion gets no ghosts; every other fusion gets all of them.
        fullest = max(
            candidates,
            key=lambda fused_tracks: len(fused_tracks.faults.ghosts) if fused_tracks.faults is not None else 0,
        )
        lists, faults = fullest.received, fullest.faults
        assert faults is not None
        until_ns = int(lists.stamp_ns[lists.frame_ix].max(initial=np.iinfo(np.int64).min))
        for unit_ix, name in enumerate(lists.units):
            if name in self._experiment.modelled:
                last_ns = self._shown_until_ns.get(name, np.iinfo(np.int64).min)
                new = (lists.stamp_ns > last_ns) & (lists.stamp_ns <= until_ns)
                frames = np.flatnonzero((lists.frame_unit_ix == unit_ix) & new)
                if len(frames):
                    self._shown_until_ns[name] = int(lists.stamp_ns[frames[-1]])
                    self._write_unit(name, lists, faults, frames)

    def _write_unit(self, name: str, lists: Tracks, faults: UnitFaults, frames: Int) -> None:
        """Write one unit's ghosts, and its outages, at the lists `frames` of a time chunk."""
        import rerun as rr

        elapsed_ns = lists.stamp_ns[frames] - self._replay.scene.t0_ns
        unit, path = self._experiment.units[name], ["world", "units", name]
        if self._experiment.pems[str(unit.pem)].ghosts:
            rows = faults.ghosts[np.isin(lists.frame_ix[faults.ghosts], frames) & lists.valid[0, faults.ghosts]]
            rows = rows[np.argsort(lists.frame_ix[rows], kind="stable")]
            place = stack_float32(*(getattr(lists, axis)[0, rows] for axis in ("x_m", "y_m", "z_m")))
            count = np.bincount(np.searchsorted(frames, lists.frame_ix[rows]), minlength=len(frames))
            self._out.columns([*path, "ghosts"], elapsed_ns, rr.Points3D.columns(positions=place).partition(count))
            mark = rr.Radius.ui_points(4)
            self._out.static([*path, "ghosts"], rr.Points3D.from_fields(colors=[FALSE], radii=mark, labels=["false"]))
        if unit.outages is not None:
            self._write_outages(path, lists, frames, faults.not_made[frames], elapsed_ns)

    def _write_outages(self, path: list[str], lists: Tracks, frames: Int, down: Bool, elapsed_ns: Int) -> None:
        import rerun as rr

        place = unit_places(self._replay, self._experiment, lists)[frames[down]]
        columns = rr.Points3D.columns(positions=stack_float32(*place.T)).partition(down.astype(np.int64))
        self._out.columns([*path, "outage"], elapsed_ns, columns)
        mark = rr.Radius.ui_points(6)
        style = rr.Points3D.from_fields(colors=[FALSE], radii=mark, labels=["makes no lists"], show_labels=True)
        self._out.static([*path, "outage"], style)
