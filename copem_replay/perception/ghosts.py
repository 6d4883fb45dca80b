"""Ghosts in the lists of units: entries about no object, which are born, last for a while and are gone.

Births are Poisson points in time, so the number of ghosts and how long they last do not depend on the list rate. Draws
of a ghost have addresses of their own. It is listed like an object: with the error of the couple that applies where it
is, and moved by the unit's pose error. A ghost stands still: in the frame of the unit, in the world, or beside its
object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.lasting import ListStamps, draw_births, drop_unshared
from copem_replay.core.memory import UnitDraws
from copem_replay.core.random import CounterRng, RandomKey, Words, object_words, stable_hash
from copem_replay.core.tracks import CLASSES, Float, Int, Scene, Tracks, append_tracks, class_indices
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.observation import Observations, compute_view
from copem_replay.perception.pem.condition import find_couples
from copem_replay.perception.pem.model import AreaPlace, GhostModel, ObjectSidePlace, class_row, draw_classes

if TYPE_CHECKING:
    from copem_replay.perception.config import PerceptionSetup
    from copem_replay.perception.sensor_poses import SensorPoses, UnitPoses


SIZES_M = {
    "pedestrian": (0.6, 0.6, 1.7), "bicycle": (1.8, 0.6, 1.7), "motorcycle": (2.2, 0.8, 1.6), "car": (4.5, 1.9, 1.6),
    "van": (5.2, 2.0, 2.1), "truck": (8.5, 2.5, 3.2), "bus": (12.0, 2.5, 3.2), "trailer": (7.0, 2.4, 2.8),
    "animal": (0.8, 0.4, 0.7), "other": (1.0, 1.0, 1.0), "vehicle": (4.5, 1.9, 1.6),
}  # fmt: skip
"""Length, width and height of a listed ghost, by class: typical sizes, to which error models add errors."""
assert tuple(SIZES_M) == CLASSES
_NUMBER_BITS = np.uint64(52)
"""Bits of a ghost's word below its number in the list: they hold 52 days of births, and no list has 4,096 ghosts."""


@dataclass(frozen=True)
class GhostRows:
    """The ghosts in the lists of one run, row by row (P,): observations of no object, all of which are listed.

    `words`: their addresses. `sort`: the place of each in its PEM's `ghosts`. `couple_ix`: the couple whose error each
    has, the one that applies where it is, else the first.
    """

    observations: Observations
    words: Words
    sort: Int


@dataclass(frozen=True)
class _UnitLists:
    """The lists (L,) of one unit that are asked for: their indices, stamps, and where the unit is at each."""

    unit_ix: int
    name: str
    frame_ix: Int
    stamp_ns: Int
    poses: UnitPoses
    pose_ix: Int  # (L,) places among the poses


@dataclass(frozen=True)
class _Born:
    """Ghosts of one sort: `words (B,)`, one for each birth, and their rows (R,), ghost by ghost in order of time.

    `ghost`: the birth of each row; `list_ix`: its list, among those of the unit that are asked for; `host`: the row of
    the object that the ghost is beside, −1: none.
    """

    words: Words
    ghost: Int
    list_ix: Int
    host: Int


def draw_ghosts(
    scene: Scene,
    observations: Observations,
    setup: PerceptionSetup,
    placed: SensorPoses,
    run: int,
    between_s: tuple[float, float],
) -> GhostRows | None:
    """The ghosts in one run's lists that are captured from the first instant on and before the second.

    `observations`: what can be listed then, of all objects; its lists are those of the whole log. None: no PEM has any.
    """
    from_s, until_s = between_s
    if not any(setup.pems[str(unit.pem)].ghosts for unit in setup.modelled.values()):
        return None
    rng, runs, pieces = CounterRng(setup.seed, scene.log), np.array([run]), [_no_ghosts(observations)]
    for u, (name, unit) in enumerate(setup.modelled.items()):
        frames = np.flatnonzero(observations.tracks.frame_unit_ix == u)
        poses = placed.poses[name]
        captured_s = observations.tracks.captured_s[frames]
        asked = (captured_s >= from_s) & (captured_s < until_s)
        stamps = observations.tracks.stamp_ns[frames[asked]]
        lists = _UnitLists(u, name, frames[asked], stamps, poses, np.flatnonzero(poses.present)[asked])
        for n, sort in enumerate(setup.pems[str(unit.pem)].ghosts):
            if sort.in_list > 0 and len(stamps):
                sort = _find_areas(sort, scene, setup)
                born = _draw_born(rng, scene, observations, lists, (n, sort), runs)
                if len(born.ghost):
                    couples = setup.pems[str(unit.pem)].couples
                    tracks, view = _place_ghosts(rng, observations.tracks, lists, (n, sort), runs, born)
                    couple_ix = np.maximum(find_couples(couples, view, scene.tags), 0)
                    sure = np.ones(len(couple_ix))
                    rows = Observations(tracks, view, couple_ix, sure, sure)
                    pieces.append(GhostRows(rows, born.words[born.ghost], np.full(len(sure), n)))
    return _join_ghosts(pieces)


def _find_areas(sort: GhostModel, scene: Scene, setup: PerceptionSetup) -> GhostModel:
    """The same ghosts, with the polygons of the areas that they are in: the experiment's own, else those of maps."""
    if not isinstance(sort.where, AreaPlace):
        return sort
    names = {*sort.where.areas}
    polygons = [of.rings_m for name, of in setup.areas.items() if name in names]
    polygons += [of.rings_m for of in scene.areas if {of.name, of.kind} & (names - setup.areas.keys())]
    return sort.model_copy(update={"where": sort.where.over(polygons)})


def make_ghost_draws(scene: Scene, ghosts: GhostRows, setup: PerceptionSetup, run: int) -> UnitDraws:
    """The random numbers of the rows of ghosts in one run."""
    tracks = ghosts.observations.tracks
    random_key = RandomKey(tracks.units, tracks.row_unit_ix, ghosts.words, tracks.stamp_ns[tracks.frame_ix])
    lists = ListStamps(tracks.stamp_ns, tracks.frame_unit_ix, tracks.frame_ix)
    return UnitDraws(CounterRng(setup.seed, scene.log), random_key, lists, np.array([run]))


def _draw_born(
    rng: CounterRng,
    scene: Scene,
    observations: Observations,
    lists: _UnitLists,
    numbered: tuple[int, GhostModel],
    runs: Int,
) -> _Born:
    """The ghosts of one sort (`numbered`: its number and model) that are in any list of a unit, and their lists."""
    n, sort = numbered
    hosts = _find_hosts(scene, observations, lists, sort)
    zeros = np.zeros(len(hosts.words), dtype=np.int64)
    random_key = RandomKey((lists.name,), zeros, hosts.words, zeros)
    salt = np.uint64(stable_hash("ghosts", n))
    if sort.lasts_s == 0:
        return _draw_fresh(rng, hosts, lists, numbered, runs, salt)
    stamps = lists.stamp_ns
    births = draw_births(
        rng, f"ghosts {n}", random_key, runs, every_s=sort.lasts_s / sort.in_list, lasts_s=sort.lasts_s,
        from_ns=int(stamps[0]), until_ns=int(stamps[-1]) + 1,
    )  # fmt: skip
    first, after = np.searchsorted(stamps, births.born_ns), np.searchsorted(stamps, births.gone_ns)
    ghost_ix = np.repeat(np.arange(len(first)), after - first)
    list_ix = np.arange(len(ghost_ix)) - np.repeat(np.cumsum(after - first) - (after - first), after - first)
    list_ix += first[ghost_ix]
    host = hosts.row[births.row_ix[ghost_ix], list_ix] if hosts.row is not None else np.full(len(ghost_ix), -1)
    beside_host = host >= 0 if hosts.row is not None else np.ones(len(ghost_ix), dtype=bool)
    words = hosts.words[births.row_ix] + births.address_ns.astype(np.uint64) + salt
    return _Born(words, ghost_ix[beside_host], list_ix[beside_host], host[beside_host])


@dataclass(frozen=True)
class _Hosts:
    """Objects that ghosts are beside: words (H,), and the row of each in each list (H, L), −1: none.

    `row` None: ghosts are beside no objects; the one word is then that of the unit.
    """

    words: Words
    row: Int | None


def _find_hosts(scene: Scene, observations: Observations, lists: _UnitLists, sort: GhostModel) -> _Hosts:
    """The objects beside which ghosts of a sort may be, with their rows in each list; of other sorts one host, all."""
    if not isinstance(sort.where, ObjectSidePlace):
        zero = np.zeros(1, dtype=np.int64)
        of_all = drop_unshared(RandomKey((lists.name,), zero, zero.astype(np.uint64), zero), "unit")
        return _Hosts(of_all.object_word, None)
    tracks = observations.tracks
    of_class = np.isin(observations.view.class_ix, class_indices(sort.where.classes)) & (observations.probability > 0)
    rows = np.flatnonzero((tracks.row_unit_ix == lists.unit_ix) & of_class)
    rows = rows[(tracks.frame_ix[rows] >= lists.frame_ix[0]) & (tracks.frame_ix[rows] <= lists.frame_ix[-1])]
    objects, object_number = np.unique(tracks.row_object_ix[rows], return_inverse=True)
    row = np.full((len(objects), len(lists.frame_ix)), -1)
    row[object_number, tracks.frame_ix[rows] - lists.frame_ix[0]] = rows
    return _Hosts(object_words(scene.object_ids)[objects], row)


def _draw_fresh(
    rng: CounterRng, hosts: _Hosts, lists: _UnitLists, numbered: tuple[int, GhostModel], runs: Int, salt: np.uint64
) -> _Born:
    """New ghosts in every list: their number follows from one uniform of each list (and host), at its capture. A
    ghost's word contains the capture, its instant of birth: so ids, and draws that last, are its own.
    """
    n, sort = numbered
    H, L = len(hosts.words), len(lists.stamp_ns)
    host_ix, list_ix = np.divmod(np.arange(H * L), L)
    if hosts.row is not None:
        present = hosts.row.ravel() >= 0
        host_ix, list_ix = host_ix[present], list_ix[present]
    zeros = np.zeros(len(host_ix), dtype=np.int64)
    random_key = RandomKey((lists.name,), zeros, hosts.words[host_ix], lists.stamp_ns[list_ix])
    [uniform] = rng.uniform(f"ghosts {n}", random_key, runs)
    count = _count_ghosts(uniform, sort.in_list)
    draw_ix = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(draw_ix)) - np.repeat(np.cumsum(count) - count, count)
    born_ns = lists.stamp_ns[list_ix[draw_ix]].astype(np.uint64)
    words = hosts.words[host_ix[draw_ix]] + born_ns + (number.astype(np.uint64) << _NUMBER_BITS) + salt
    host = hosts.row[host_ix[draw_ix], list_ix[draw_ix]] if hosts.row is not None else np.full(len(draw_ix), -1)
    return _Born(words, np.arange(len(draw_ix)), list_ix[draw_ix], host)


def _count_ghosts(uniform: Float, mean: float) -> Int:
    """The least numbers whose Poisson distribution reaches `uniform`; `pdtrik` is a real number near them."""
    from scipy.special import pdtr, pdtrik

    above = np.ceil(pdtrik(uniform, mean))
    below = np.maximum(above - 1, 0)
    count: Int = np.where(pdtr(below, mean) >= uniform, below, above).astype(np.int64)
    return count


def _place_ghosts(
    rng: CounterRng, true: Tracks, lists: _UnitLists, numbered: tuple[int, GhostModel], runs: Int, born: _Born
) -> tuple[Tracks, ViewGeometry]:
    """Tracks of the ghosts, without any error, and their view geometry from the unit: visible share 1."""
    n, sort = numbered
    zeros = np.zeros(len(born.words), dtype=np.int64)
    random_key = RandomKey((lists.name,), zeros, born.words, zeros)
    place_draws = np.stack([rng.uniform(f"ghosts {n} place {k}", random_key, runs)[0] for k in range(3)])
    turn_rad = 2 * np.pi * rng.uniform(f"ghosts {n} turn", random_key, runs)[0]
    shares = class_row(sort.classes)[None]
    class_ix = draw_classes(shares, zeros, rng.uniform(f"ghosts {n} class", random_key, runs)[0])[born.ghost]
    pose_ix, poses, host = lists.pose_ix[born.list_ix], lists.poses, born.host
    x_m, y_m, heading_rad = poses.x_m[pose_ix], poses.y_m[pose_ix], poses.heading_rad[pose_ix]
    ground_m, length_m, width_m = poses.ground_m[pose_ix], np.zeros(len(born.words)), np.zeros(len(born.words))
    if sort.where.frame == "world":
        x_m = y_m = heading_rad = np.zeros(len(pose_ix))
    elif sort.where.frame == "object":
        x_m, y_m, heading_rad = true.x_m[0, host], true.y_m[0, host], true.yaw_rad[0, host]
        ground_m = true.z_m[0, host] - true.height_m[0, host] / 2
        # An object has one size in all lists, so any row of its ghost gives it.
        length_m[born.ghost], width_m[born.ghost] = true.length_m[0, host], true.width_m[0, host]
    ahead_m, left_m = sort.where.places_m(place_draws, length_m, width_m)[:, born.ghost]
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    size_m = np.array(list(SIZES_M.values()))[class_ix]
    values = {
        "x_m": x_m + cos * ahead_m - sin * left_m,
        "y_m": y_m + sin * ahead_m + cos * left_m,
        "z_m": ground_m + size_m[:, 2] / 2,
        "yaw_rad": wrap_angles(heading_rad + turn_rad[born.ghost]),
        "vx_mps": np.zeros(len(pose_ix)),
        "vy_mps": np.zeros(len(pose_ix)),
        "length_m": size_m[:, 0],
        "width_m": size_m[:, 1],
        "height_m": size_m[:, 2],
    }
    tracks = _make_ghost_tracks(true, lists, born, values)
    return tracks, compute_view(tracks, poses, pose_ix, np.ones(len(pose_ix)), class_ix.astype(np.int8))


def _make_ghost_tracks(true: Tracks, lists: _UnitLists, born: _Born, values: dict[str, Float]) -> Tracks:
    """Rows of one run as tracks in the lists of `true`, a track for each ghost, without objects (−1)."""
    start = np.append(np.flatnonzero(np.diff(born.ghost, prepend=-1)), len(born.ghost))
    return Tracks(
        units=true.units,
        start=start,
        unit_ix=np.full(len(start) - 1, lists.unit_ix),
        object_ix=np.full(len(start) - 1, -1),
        frame_ix=lists.frame_ix[born.list_ix],
        stamp_ns=true.stamp_ns,
        captured_s=true.captured_s,
        frame_unit_ix=true.frame_unit_ix,
        arrives_s=true.arrives_s,
        valid=np.ones((1, len(born.ghost)), dtype=bool),
        **{name: column[None] for name, column in values.items()},
    )


def _no_ghosts(observations: Observations) -> GhostRows:
    none = observations.take_rows(np.empty(0, dtype=np.int64))
    return GhostRows(none, np.empty(0, dtype=np.uint64), np.empty(0, dtype=np.int64))


def _join_ghosts(pieces: Sequence[GhostRows]) -> GhostRows:
    """Rows of several sorts and units one after the other."""
    tracks = pieces[0].observations.tracks
    for piece in pieces[1:]:
        tracks = append_tracks(tracks, piece.observations.tracks)

    def rows(name: str) -> Float:
        return np.concatenate([getattr(piece.observations, name) for piece in pieces])

    view = ViewGeometry.joined([piece.observations.view for piece in pieces])
    couple_ix = np.concatenate([piece.observations.couple_ix for piece in pieces])
    observations = Observations(tracks, view, couple_ix, rows("probability"), rows("existence"))
    return GhostRows(
        observations,
        np.concatenate([piece.words for piece in pieces]),
        np.concatenate([piece.sort for piece in pieces]),
    )
