"""Who could be listed: every object in every list of every unit, and how it looks from there.

Nothing here depends on the run, on a model's parameters or on a configuration: computed once per log and shared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from copem_replay.experiment import Experiment
from copem_replay.pem.condition import applies
from copem_replay.pem.detection import probability_of
from copem_replay.pem.look import Look
from copem_replay.resample import at_instants, wrap
from copem_replay.tracks import VALUES, Float, Int, Scene, Tracks, joined
from copem_replay.units import (
    Poses,
    carrier,
    list_instants,
    observers,
    place_obstacles,
    poses,
    unit_ground,
)
from copem_replay.visibility import Statics, visible_shares


@dataclass(frozen=True)
class Candidates:
    """True states of all candidate rows (one run), how they look, and with which probability they are listed.

    `couple_ix (P,)`: the couple of the unit's PEM that applies, −1: none. `probability (P,)`, and `existence (P,)` as
    the unit claims it of what it lists.
    `poses` and the lists of each unit are in the experiment's order.
    """

    tracks: Tracks
    look: Look
    couple_ix: Int
    probability: Float
    existence: Float
    poses: dict[str, Poses]
    static: Statics
    notes: tuple[str, ...]

    def of_objects(self, object_ix: Int) -> Candidates:
        """Only the rows of some objects: for what concerns each object by itself."""
        tracks = np.isin(self.tracks.object_ix, object_ix)
        rows = np.flatnonzero(tracks[self.tracks.track_ix])
        return replace(
            self,
            tracks=self.tracks.take_tracks(tracks),
            look=self.look.take(rows),
            couple_ix=self.couple_ix[rows],
            probability=self.probability[rows],
            existence=self.existence[rows],
        )


def candidates(scene: Scene, truth: Tracks, experiment: Experiment) -> Candidates:
    """All candidate rows of an experiment's units over one log (`truth`: the world at its own frames)."""
    notes: list[str] = []
    static = place_obstacles(truth, experiment.obstacles, notes)
    worlds: dict[bytes, tuple[Tracks, list[str]]] = {}
    for name, unit in experiment.modelled.items():
        stamps = list_instants(scene, truth, unit)
        if stamps.tobytes() not in worlds:
            world = truth if unit.rate_hz is None else _world(scene, truth, stamps, experiment.max_gap_s)
            worlds[stamps.tobytes()] = (world, [])
        worlds[stamps.tobytes()][1].append(name)
    unit_poses: dict[str, Poses] = {}
    pieces: dict[str, tuple[Tracks, Look]] = {}
    for world, names in worlds.values():
        for name in names:
            unit = experiment.units[name]
            unit_poses[name] = poses(scene, unit, world, unit_ground(truth, name, unit, notes))
        carriers = np.array([carrier(scene, experiment.units[name]) for name in names])
        places = [unit_poses[name] for name in names]
        shares = visible_shares(
            world,
            static,
            observers(places, carriers),
            flat=experiment.visibility == "flat",
        )
        for k, name in enumerate(names):
            pieces[name] = _from_unit(world, places[k], int(carriers[k]), shares[k])
    ordered = [pieces[name] for name in experiment.modelled]
    tracks = joined(tuple(experiment.modelled), [piece[0] for piece in ordered])
    look = Look(
        **{
            name: np.concatenate([np.empty(0), *(getattr(piece[1], name) for piece in ordered)])
            for name in Look.__dataclass_fields__
        }
    )
    look = replace(look, class_ix=scene.object_class[tracks.row_object_ix])
    couple_ix, probability, existence = _assess(tracks, look, experiment)
    for k, name in enumerate(experiment.modelled):
        if not (tracks.frame_unit_ix == k).any():
            notes.append(f"unit {name}: makes no list, its carrier is never there")
        elif not (couple_ix[tracks.row_unit_ix == k] >= 0).any():
            notes.append(f"unit {name}: no object ever meets a condition of its PEM {experiment.units[name].pem!r}")
    return Candidates(tracks, look, couple_ix, probability, existence, unit_poses, static, tuple(notes))


def _world(scene: Scene, truth: Tracks, stamps: Int, max_gap_s: float) -> Tracks:
    return at_instants(truth, stamps, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)


def _from_unit(world: Tracks, at: Poses, carrier_ix: int, share: Float) -> tuple[Tracks, Look]:
    """The candidate rows of one unit: all but its carrier, at the lists it exists for."""
    keep = at.present[world.frame_ix] & (world.row_object_ix != carrier_ix)
    frames = np.flatnonzero(at.present)
    frame_number = np.cumsum(at.present) - 1
    lengths = np.bincount(world.track_ix[keep], minlength=len(world.object_ix))
    held = lengths > 0
    frame = world.frame_ix[keep]
    tracks = replace(
        world,
        start=np.concatenate([[0], np.cumsum(lengths[held])]),
        unit_ix=world.unit_ix[held],
        object_ix=world.object_ix[held],
        frame_ix=frame_number[frame],
        stamp_ns=world.stamp_ns[frames],
        captured_s=world.captured_s[frames],
        frame_unit_ix=world.frame_unit_ix[frames],
        arrives_s=world.arrives_s[:, frames],
        valid=world.valid[:, keep],
        **{name: getattr(world, name)[:, keep] for name in VALUES},
    )
    dx, dy = tracks.x_m[0] - at.x_m[frame], tracks.y_m[0] - at.y_m[frame]
    bearing = np.arctan2(dy, dx)
    look = Look(
        range_m=np.hypot(dx, dy),
        azimuth_rad=wrap(bearing - at.heading_rad[frame]),
        bearing_rad=bearing,
        visible_share=share[keep],
        class_ix=np.empty(0, dtype=np.int8),
        length_m=tracks.length_m[0],
        width_m=tracks.width_m[0],
        height_m=tracks.height_m[0],
        yaw_rad=tracks.yaw_rad[0],
        speed_mps=np.hypot(tracks.vx_mps[0], tracks.vy_mps[0]),
    )
    return tracks, look


def _assess(tracks: Tracks, look: Look, experiment: Experiment) -> tuple[Int, Float, Float]:
    """Which couple of its unit's PEM applies to each row, the probability it gives, and the existence it claims."""
    couple_ix = np.full(len(tracks.frame_ix), -1)
    probability, existence = np.zeros(len(tracks.frame_ix)), np.zeros(len(tracks.frame_ix))
    for k, unit in enumerate(experiment.modelled.values()):
        rows = np.flatnonzero(tracks.row_unit_ix == k)
        seen = look.take(rows)
        pem = experiment.pems[str(unit.pem)]
        couple_ix[rows] = applies(pem, seen)
        for c, couple in enumerate(pem):
            mine = rows[couple_ix[rows] == c]
            if len(mine):
                where = f"pems.{unit.pem}[{c}].detection"
                probability[mine] = probability_of(couple.detection, look.take(mine), where)
                claimed = couple.existence
                existence[mine] = look.visible_share[mine] if claimed == "visible_share" else claimed
    return couple_ix, probability, existence
