"""Observations: every object in every list of every unit, and its view geometry from there.

Nothing here depends on the run, on a model's parameters or on a configuration: computed once per log and shared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.interpolation import AROUND_S, at_instants, wrap
from copem_replay.core.tracks import Bool, Float, Int, Scene, Tracks, joined, spliced
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.config import PerceptionSetup
from copem_replay.perception.pem.condition import applies
from copem_replay.perception.pem.detection import probability_of
from copem_replay.perception.pem.scores import Scores
from copem_replay.perception.sensor_poses import SensorPoses, UnitPoses, observers, place
from copem_replay.perception.visibility import visible_shares


@dataclass(frozen=True)
class Observations:
    """True states of all observation rows (one run), their view geometry, and with which probability they are listed.

    `couple_ix (P,)`: the couple of the unit's PEM that applies, −1: none. `probability (P,)`, and `existence (P,)` as
    the unit claims it of what it lists. The units and their lists are in the experiment's order.
    """

    tracks: Tracks
    view: ViewGeometry
    couple_ix: Int
    probability: Float
    existence: Float

    def of_objects(self, object_ix: Int) -> Observations:
        """Only the rows of some objects: for what concerns each object by itself."""
        of_track = np.isin(self.tracks.object_ix, object_ix)
        return self if of_track.all() else self.take_rows(np.flatnonzero(of_track[self.tracks.track_ix]))

    def take_rows(self, rows: Int) -> Observations:
        """Only some rows, ascending (K,)."""
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
    """Visible shares of time chunks of a log: what takes longest of their observations, and least to keep.

    Kept as long as there is room: one number of each row, where the rows themselves would be forty.
    """

    def __init__(self, room_bytes: int = 256_000_000) -> None:
        self._room_bytes = room_bytes
        self._kept: dict[tuple[str, float, float], Float] = {}

    def of(
        self, units: str, world: Tracks, times_s: tuple[float, float, float], seen: Callable[[Tracks], Float]
    ) -> Float:
        """Shares (U, P) of a world captured from the first time on and before the last, cut at the one between.

        `units`: their name. Each part is computed once.
        """
        from_s, cut_s, until_s = times_s
        shares = self._part(units, world, cut_s, until_s, seen)
        if from_s >= cut_s:
            return shares
        late = world.row_captured_s >= cut_s
        whole = np.empty((len(shares), len(late)))
        whole[:, late] = shares
        whole[:, ~late] = self._part(units, world, from_s, cut_s, seen)
        return whole

    def _part(self, units: str, world: Tracks, from_s: float, until_s: float, seen: Callable[[Tracks], Float]) -> Float:
        found = self._kept.get((units, from_s, until_s))
        if found is None:
            found = seen(world.captured_between(from_s, until_s))
            if found.nbytes <= self._room_bytes:
                self._room_bytes -= found.nbytes
                self._kept[units, from_s, until_s] = found
        return found


def joined_chunks(pieces: Sequence[Observations]) -> Observations:
    """Rows of time chunks that follow each other, as of one."""
    if len(pieces) == 1:
        return pieces[0]
    tracks, order = spliced([piece.tracks for piece in pieces])

    def rows(columns: Sequence[Any]) -> Any:
        return np.concatenate(columns)[order]

    view = ViewGeometry.joined([piece.view for piece in pieces]).take(order)
    more = (rows([getattr(piece, f) for piece in pieces]) for f in ("couple_ix", "probability", "existence"))
    return Observations(tracks, view, *more)


def observations(
    scene: Scene,
    truth: Tracks,
    experiment: PerceptionSetup,
    placed: SensorPoses | None = None,
    *,
    from_s: float = -np.inf,
    until_s: float = np.inf,
    kept: KeptShares | None = None,
    cut_s: float | None = None,
) -> Observations:
    """All observation rows of an experiment's units over one log (`truth`: the world at its own frames).

    Of a time chunk only the rows captured from an instant on and before another; lists are always all there. `placed`:
    where the units are, None: to be found out. `kept`: of the same log and units; `cut_s`: from where on other calls
    will ask for the same rows, None: `from_s`.
    """
    if placed is None:
        placed = place(scene, truth, experiment)
    pieces: dict[str, tuple[Tracks, ViewGeometry]] = {}
    for names, world in worlds(scene, truth, experiment, placed, from_s, until_s):
        places = [placed.poses[name] for name in names]
        carriers = np.array([placed.carrier_ix[name] for name in names])
        watching = observers(places, carriers)
        seen = partial(visible_shares, static=placed.static, observers=watching, model=experiment.visibility)
        shares = seen(world) if kept is None else kept.of(names[0], world, (from_s, cut_s or from_s, until_s), seen)
        for k, name in enumerate(names):
            pieces[name] = from_unit(world, places[k], int(carriers[k]), shares[k])
    ordered = [pieces[name] for name in experiment.modelled]
    nothing = ViewGeometry(*np.empty((len(fields(ViewGeometry)), 0)))
    tracks = joined(tuple(experiment.modelled), [piece[0] for piece in ordered])
    view = ViewGeometry.joined([nothing, *(piece[1] for piece in ordered)])
    view = replace(view, class_ix=scene.object_class[tracks.row_object_ix])
    return Observations(tracks, view, *_assess(tracks, view, experiment))


def worlds(
    scene: Scene, truth: Tracks, experiment: PerceptionSetup, placed: SensorPoses, from_s: float, until_s: float
) -> Iterator[tuple[list[str], Tracks]]:
    """The world at the lists of the modelled units, once for all that have theirs at the same instants (by name)."""
    together: dict[bytes, list[str]] = {}
    for name, stamps in placed.stamps_ns.items():
        together.setdefault(stamps.tobytes(), []).append(name)
    for names in together.values():
        if experiment.units[names[0]].rate_hz is None:
            yield names, truth.captured_between(from_s, until_s)
        else:
            yield names, _world(scene, truth, placed.stamps_ns[names[0]], experiment.max_gap_s, from_s, until_s)


def _world(scene: Scene, truth: Tracks, stamps: Int, max_gap_s: float, from_s: float, until_s: float) -> Tracks:
    """The world at a unit's list instants."""
    around_s = max_gap_s + AROUND_S
    near = truth.captured_between(from_s - around_s, until_s + around_s)
    world = at_instants(near, stamps, t0_ns=scene.t0_ns, max_gap_s=max_gap_s)
    return world.captured_between(from_s, until_s)


def from_unit(world: Tracks, at: UnitPoses, carrier_ix: int, share: Float) -> tuple[Tracks, ViewGeometry]:
    """The rows of one unit, all but its carrier, at the lists it exists for, and their view but for the class."""
    keep = at.present[world.frame_ix] & (world.row_object_ix != carrier_ix)
    frames = np.flatnonzero(at.present)
    frame = world.frame_ix[keep]
    tracks = replace(
        world.take_rows(np.flatnonzero(keep)),
        frame_ix=(np.cumsum(at.present) - 1)[frame],
        stamp_ns=world.stamp_ns[frames],
        captured_s=world.captured_s[frames],
        frame_unit_ix=world.frame_unit_ix[frames],
        arrives_s=world.arrives_s[:, frames],
    )
    return tracks, view_from(tracks, at, frame, share[keep], np.empty(0, dtype=np.int8))


def view_from(tracks: Tracks, at: UnitPoses, pose_ix: Int, share: Float, class_ix: NDArray[np.int8]) -> ViewGeometry:
    """How rows (P,) look from a unit, each from where it is at one of its poses, `pose_ix` (P,)."""
    dx, dy = tracks.x_m[0] - at.x_m[pose_ix], tracks.y_m[0] - at.y_m[pose_ix]
    bearing = np.arctan2(dy, dx)
    return ViewGeometry(
        range_m=np.hypot(dx, dy),
        azimuth_rad=wrap(bearing - at.heading_rad[pose_ix]),
        bearing_rad=bearing,
        visible_share=share,
        class_ix=class_ix,
        length_m=tracks.length_m[0],
        width_m=tracks.width_m[0],
        height_m=tracks.height_m[0],
        yaw_rad=tracks.yaw_rad[0],
        speed_mps=np.hypot(tracks.vx_mps[0], tracks.vy_mps[0]),
    )


def _assess(tracks: Tracks, view: ViewGeometry, experiment: PerceptionSetup) -> tuple[Int, Float, Float]:
    """Which couple of its unit's PEM applies to each row, the probability it gives, and the existence it claims."""
    couple_ix = np.full(len(tracks.frame_ix), -1)
    probability, existence = np.zeros(len(tracks.frame_ix)), np.zeros(len(tracks.frame_ix))
    for unit, rows in zip(experiment.modelled.values(), rows_by_unit(tracks), strict=True):
        seen = view.take(rows)
        pem = experiment.pems[str(unit.pem)].couples
        couple_ix[rows] = applies(pem, seen)
        for c, couple in enumerate(pem):
            mine = rows[couple_ix[rows] == c]
            if len(mine):
                where = f"pems.{unit.pem}[{c}].detection"
                probability[mine] = probability_of(couple.detection, view.take(mine), where)
                claimed = couple.existence
                if not isinstance(claimed, Scores):  # those are drawn of each run: perception/claims.py
                    existence[mine] = view.visible_share[mine] if claimed == "visible_share" else claimed
    return couple_ix, probability, existence


def rows_by_unit(tracks: Tracks) -> list[Int]:
    """The rows of each unit, ascending."""
    order = np.argsort(tracks.row_unit_ix, kind="stable")
    bounds = np.searchsorted(tracks.row_unit_ix[order], np.arange(len(tracks.units) + 1))
    return [order[first:after] for first, after in pairwise(bounds.tolist())]
