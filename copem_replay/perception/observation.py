"""Observations: every object in every list of every unit, and its view geometry from the unit.

Nothing here depends on the run, on a model's parameters or on a configuration: it is computed once per log and shared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.interpolation import AROUND_S, interpolate_at_instants, wrap_angles
from copem_replay.core.tracks import Bool, Float, Int, Scene, Tracks, join_tracks, splice_rows
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.config import PerceptionSetup
from copem_replay.perception.pem.condition import ExistenceScores, find_couples, may_apply
from copem_replay.perception.pem.detection import ask_detection_probability
from copem_replay.perception.sensor_poses import SensorPoses, UnitPoses, make_observers, place_units
from copem_replay.perception.visibility import visible_shares


@dataclass(frozen=True)
class Observations:
    """True states of all observation rows (one run), their view geometry, and the probability that each is listed.

    `couple_ix (P,)`: the couple of the unit's PEM that applies, −1: none. `probability (P,)`, and `existence (P,)` as
    the unit claims it of what it lists. The units and their lists are in the experiment's order.
    """

    tracks: Tracks
    view: ViewGeometry
    couple_ix: Int
    probability: Float
    existence: Float

    def of_objects(self, object_ix: Int) -> Observations:
        """Only the rows of the objects `object_ix`."""
        of_track = np.isin(self.tracks.object_ix, object_ix)
        return self if of_track.all() else self.take_rows(np.flatnonzero(of_track[self.tracks.track_ix]))

    def take_rows(self, rows: Int) -> Observations:
        """Only the rows `rows (K,)`, ascending."""
        return Observations(
            self.tracks.take_rows(rows),
            self.view.take(rows),
            self.couple_ix[rows],
            self.probability[rows],
            self.existence[rows],
        )

    @cached_property
    def listable(self) -> Observations:
        """Only the rows that are listed with any probability: the others are in no list of any run."""
        return self if (self.probability > 0).all() else self.take_rows(np.flatnonzero(self.probability > 0))

    @property
    def ever_met(self) -> Bool:
        """(U,) whether a condition of each unit's PEM is met by any object here."""
        met = np.bincount(self.tracks.row_unit_ix[self.couple_ix >= 0], minlength=len(self.tracks.units)) > 0
        return np.asarray(met)


class KeptShares:
    """Visible shares of time chunks of a log: they take most of the time of observations, and little memory.

    They are kept as long as there is room: one number for each row, where the rows themselves would take forty.
    """

    def __init__(self, room_bytes: int = 256_000_000) -> None:
        self._room_bytes = room_bytes
        self._kept: dict[tuple[str, float, float], Float] = {}

    def of(
        self, units: str, world: Tracks, times_s: tuple[float, float, float], compute: Callable[[Tracks], Float]
    ) -> Float:
        """Visible shares (U, P) of a world captured from the first of `times_s` on and before the last, cut at the
        middle one. `units`: a name for the units. `compute` is asked once for each part.
        """
        from_s, cut_s, until_s = times_s
        shares = self._part(units, world, cut_s, until_s, compute)
        if from_s >= cut_s:
            return shares
        is_late = world.row_captured_s >= cut_s
        shares_of_all = np.empty((len(shares), len(is_late)))
        shares_of_all[:, is_late] = shares
        shares_of_all[:, ~is_late] = self._part(units, world, from_s, cut_s, compute)
        return shares_of_all

    def _part(self, units: str, world: Tracks, from_s: float, until_s: float, seen: Callable[[Tracks], Float]) -> Float:
        shares = self._kept.get((units, from_s, until_s))
        if shares is None:
            shares = seen(world.captured_between(from_s, until_s))
            if shares.nbytes <= self._room_bytes:
                self._room_bytes -= shares.nbytes
                self._kept[units, from_s, until_s] = shares
        return shares


def join_observations(pieces: Sequence[Observations]) -> Observations:
    """The rows of consecutive time chunks as those of one."""
    if len(pieces) == 1:
        return pieces[0]
    tracks, order = splice_rows([piece.tracks for piece in pieces])

    def rows(columns: Sequence[Any]) -> Any:
        return np.concatenate(columns)[order]

    view = ViewGeometry.joined([piece.view for piece in pieces]).take(order)
    columns_of_rows = (rows([getattr(piece, f) for piece in pieces]) for f in ("couple_ix", "probability", "existence"))
    return Observations(tracks, view, *columns_of_rows)


def observe_objects(
    scene: Scene,
    truth: Tracks,
    experiment: PerceptionSetup,
    placed: SensorPoses | None = None,
    *,
    from_s: float = -np.inf,
    until_s: float = np.inf,
    cache: KeptShares | None = None,
    cut_s: float | None = None,
    as_read: bool = False,
    only_ix: Int | None = None,
) -> Observations:
    """All observation rows of an experiment's units over one log (`truth`: the world at its own frames).

    Only rows captured from `from_s` on and before `until_s` (a time chunk); lists are always complete. `placed`: where
    the units are, None: it is computed. `cache`: visible shares of this log and its units; `cut_s`: the instant from
    which on other calls ask for these rows again, None: `from_s`.

    `as_read`: shares are NaN where nothing reads them: where no couple can apply, except for the ego. `only_ix`: the
    objects whose rows are wanted, None: of all.
    """
    if placed is None:
        placed = place_units(scene, truth, experiment)
    pieces: dict[str, tuple[Tracks, ViewGeometry]] = {}
    for names, world in interpolate_worlds(scene, truth, experiment, placed, from_s, until_s):
        needed = partial(
            _ask_for_shares, names, scene=scene, experiment=experiment, placed=placed, as_read=as_read, only_ix=only_ix,
        )  # fmt: skip
        see = partial(_see_world, names, experiment=experiment, placed=placed, needed=needed)
        shares = see(world) if cache is None else cache.of(names[0], world, (from_s, cut_s or from_s, until_s), see)
        if only_ix is not None:
            rows = np.flatnonzero(np.isin(world.row_object_ix, only_ix))
            world, shares = world.take_rows(rows), shares[:, rows]
        for k, name in enumerate(names):
            pieces[name] = view_world_from_unit(world, placed.poses[name], placed.carrier_ix[name], shares[k])
    ordered = [pieces[name] for name in experiment.modelled]
    nothing = ViewGeometry(*np.empty((len(fields(ViewGeometry)), 0)))
    tracks = join_tracks(tuple(experiment.modelled), [piece[0] for piece in ordered])
    view = ViewGeometry.joined([nothing, *(piece[1] for piece in ordered)])
    view = replace(view, class_ix=scene.object_class[tracks.row_object_ix])
    return Observations(tracks, view, *_assess_rows(tracks, view, experiment, scene.tags))


def _see_world(
    names: Sequence[str], world: Tracks, *, experiment: PerceptionSetup, placed: SensorPoses,
    needed: Callable[[Tracks], Bool | None],
) -> Float:  # fmt: skip
    """Visible shares (U, P) of a world at the lists of the units `names`."""
    carriers = np.array([placed.carrier_ix[name] for name in names])
    watching = make_observers([placed.poses[name] for name in names], carriers)
    return visible_shares(world, placed.static, watching, experiment.visibility, needed(world))


def _ask_for_shares(
    names: Sequence[str], world: Tracks, *, scene: Scene, experiment: PerceptionSetup, placed: SensorPoses,
    as_read: bool, only_ix: Int | None,
) -> Bool | None:  # fmt: skip
    """(U, P) which visible shares are needed: where a PEM may apply (`as_read`), or of one object; None: all."""
    if only_ix is not None:
        return np.tile(np.isin(world.row_object_ix, only_ix), (len(names), 1))
    if not as_read:
        return None
    class_ix, is_ego = scene.object_class[world.row_object_ix], world.row_object_ix == scene.ego_ix
    needed: Bool = np.empty((len(names), len(is_ego)), dtype=bool)
    for k, name in enumerate(names):
        pem = experiment.pems[str(experiment.units[name].pem)].couples
        with np.errstate(invalid="ignore"):  # where the unit is absent
            view = compute_view(world, placed.poses[name], world.frame_ix, np.zeros(len(is_ego)), class_ix)
            needed[k] = is_ego | may_apply(pem, view, scene.tags)
    return needed


def interpolate_worlds(
    scene: Scene, truth: Tracks, experiment: PerceptionSetup, placed: SensorPoses, from_s: float, until_s: float
) -> Iterator[tuple[list[str], Tracks]]:
    """The world at the lists of the modelled units: names of units with equal list instants, and the world there."""
    names_by_stamps: dict[bytes, list[str]] = {}
    for name in experiment.modelled:
        names_by_stamps.setdefault(placed.stamps_ns[name].tobytes(), []).append(name)
    for names in names_by_stamps.values():
        if experiment.units[names[0]].rate_hz is None:
            yield names, truth.captured_between(from_s, until_s)
        else:
            yield (
                names,
                _interpolate_world(scene, truth, placed.stamps_ns[names[0]], experiment.max_gap_s, from_s, until_s),
            )


def _interpolate_world(
    scene: Scene, truth: Tracks, stamps: Int, max_gap_s: float, from_s: float, until_s: float
) -> Tracks:
    """The world at a unit's list instants."""
    around_s = max_gap_s + AROUND_S
    near = truth.captured_between(from_s - around_s, until_s + around_s)
    world = interpolate_at_instants(near, stamps, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)
    return world.captured_between(from_s, until_s)


def view_world_from_unit(world: Tracks, poses: UnitPoses, carrier_ix: int, share: Float) -> tuple[Tracks, ViewGeometry]:
    """The rows of one unit: all objects but its carrier, at lists with the unit present; and their view but class."""
    keep = poses.present[world.frame_ix] & (world.row_object_ix != carrier_ix)
    frames = np.flatnonzero(poses.present)
    frame = world.frame_ix[keep]
    tracks = replace(
        world.take_rows(np.flatnonzero(keep)),
        frame_ix=(np.cumsum(poses.present) - 1)[frame],
        stamp_ns=world.stamp_ns[frames],
        captured_s=world.captured_s[frames],
        frame_unit_ix=world.frame_unit_ix[frames],
        arrives_s=world.arrives_s[:, frames],
    )
    return tracks, compute_view(tracks, poses, frame, share[keep], np.empty(0, dtype=np.int8))


def compute_view(
    tracks: Tracks, poses: UnitPoses, pose_ix: Int, share: Float, class_ix: NDArray[np.int8]
) -> ViewGeometry:
    """View geometry of rows (P,) from a unit, each from the pose `pose_ix (P,)` of the unit."""
    dx, dy = tracks.x_m[0] - poses.x_m[pose_ix], tracks.y_m[0] - poses.y_m[pose_ix]
    bearing = np.arctan2(dy, dx)
    return ViewGeometry(
        range_m=np.hypot(dx, dy),
        azimuth_rad=wrap_angles(bearing - poses.heading_rad[pose_ix]),
        bearing_rad=bearing,
        visible_share=share,
        class_ix=class_ix,
        length_m=tracks.length_m[0],
        width_m=tracks.width_m[0],
        height_m=tracks.height_m[0],
        yaw_rad=tracks.yaw_rad[0],
        speed_mps=np.hypot(tracks.vx_mps[0], tracks.vy_mps[0]),
    )


def _assess_rows(
    tracks: Tracks, view: ViewGeometry, experiment: PerceptionSetup, tags: Mapping[str, str]
) -> tuple[Int, Float, Float]:
    """(P,) the couple of its unit's PEM that applies to each row (−1: none), its probability, and its existence."""
    couple_ix = np.full(len(tracks.frame_ix), -1)
    probability, existence = np.zeros(len(tracks.frame_ix)), np.zeros(len(tracks.frame_ix))
    for unit, rows in zip(experiment.modelled.values(), rows_by_unit(tracks), strict=True):
        pem = experiment.pems[str(unit.pem)].couples
        couple_ix[rows], probability[rows] = assess_view(str(unit.pem), experiment, view.take(rows), tags)
        for c, couple in enumerate(pem):
            couple_rows = rows[couple_ix[rows] == c]
            if len(couple_rows):
                claimed = couple.existence
                if not isinstance(claimed, ExistenceScores):  # drawn for each run, in perception/perceive.py
                    existence[couple_rows] = view.visible_share[couple_rows] if claimed == "visible_share" else claimed
    return couple_ix, probability, existence


def assess_view(
    pem: str, experiment: PerceptionSetup, view: ViewGeometry, tags: Mapping[str, str]
) -> tuple[Int, Float]:
    """Of each row (P,) of a view the couple of the PEM that applies, and its probability: 0 where none does."""
    couples = experiment.pems[pem].couples
    couple_ix, probability = find_couples(couples, view, tags), np.zeros(len(view.range_m))
    for c, couple in enumerate(couples):
        rows = np.flatnonzero(couple_ix == c)
        if len(rows):
            probability[rows] = ask_detection_probability(
                couple.detection, view.take(rows), f"pems.{pem}[{c}].detection"
            )
    return couple_ix, probability


def rows_by_unit(tracks: Tracks) -> list[Int]:
    """The rows of each unit, ascending, unit by unit."""
    order = np.argsort(tracks.row_unit_ix, kind="stable")
    bounds = np.searchsorted(tracks.row_unit_ix[order], np.arange(len(tracks.units) + 1))
    return [order[first:after] for first, after in pairwise(bounds.tolist())]
