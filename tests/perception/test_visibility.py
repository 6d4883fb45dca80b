"""Visible shares against the plainly written oracle, over random scenes and recordings, and in scenes done by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.tracks import Solid, Tracks, outline_solids
from copem_replay.io.recording import read_log
from copem_replay.perception.visibility import (
    NO_STATICS,
    Flat,
    Observers,
    Statics,
    Surface,
    box_corners,
    cut_convex,
    find_blockers,
    make_statics,
    visible_shares,
)
from tests.oracles.visibility import flat_share, prism, random_observer, random_scene, rectangle, surface_share

DATA = Path(__file__).parents[2].parent / "shared" / "data"
ERROR = 0.01  # the most that any view may be off


def one_list(boxes: Sequence[tuple[float, float, float, float, float, float, float]]) -> Tracks:
    """A list of boxes: x, y, yaw, length, width, bottom, top."""
    x, y, yaw, length, width, bottom, top = np.array(boxes, dtype=float).T
    n = len(boxes)
    return Tracks(
        units=("truth",),
        start=np.arange(n + 1),
        unit_ix=np.zeros(n, dtype=int),
        object_ix=np.arange(n),
        frame_ix=np.zeros(n, dtype=int),
        stamp_ns=np.zeros(1, dtype=np.int64),
        captured_s=np.zeros(1),
        frame_unit_ix=np.zeros(1, dtype=int),
        arrives_s=np.zeros((1, 1)),
        valid=np.ones((1, n), dtype=bool),
        x_m=x[None],
        y_m=y[None],
        z_m=(bottom + top)[None] / 2,
        yaw_rad=yaw[None],
        vx_mps=np.zeros((1, n)),
        vy_mps=np.zeros((1, n)),
        length_m=length[None],
        width_m=width[None],
        height_m=(top - bottom)[None],
    )


def shares(
    world: Tracks, observer: Sequence[float], static: Statics = NO_STATICS, *, flat: bool, carrier: int = -1
) -> np.ndarray:
    """(P,) shares from one place."""
    return visible_shares(world, static, at(observer, carrier), Flat() if flat else Surface())[0]


def at(observer: Sequence[float], carrier: int = -1) -> Observers:
    """One unit at one place."""
    place = np.array(observer, dtype=float).reshape(1, 1, 3)
    return Observers(place, np.ones((1, 1), dtype=bool), np.array([carrier]))


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("height_m", [0.6, 1.8, 5.0])
def test_random_scenes_agree_with_the_oracle(seed: int, height_m: float) -> None:
    rng = np.random.default_rng([seed, int(height_m * 10)])
    bodies = random_scene(rng, boxes=10 + seed % 12, radius_m=18.0 + seed)
    observer = random_observer(rng, bodies, height_m)
    boxes, walls = [b for b in bodies if not b["static"]], [b for b in bodies if b["static"]]
    corners = [np.asarray(b["polygon"]) for b in boxes]
    # A rectangle's corners say its pose; the oracle only ever sees the corners.
    poses = [
        (
            *c.mean(axis=0),
            np.arctan2(*(c[0] - c[1])[::-1]),
            np.hypot(*(c[0] - c[1])),
            np.hypot(*(c[1] - c[2])),
            b["z0"],
            b["z1"],
        )
        for b, c in zip(boxes, corners, strict=True)
    ]
    static = make_statics([b["polygon"] for b in walls], [b["z0"] for b in walls], [b["z1"] - b["z0"] for b in walls])
    world = one_list(poses)
    flat, surface = (shares(world, observer, static, flat=f) for f in (True, False))
    for k in range(len(boxes)):
        others = [b for b in bodies if b is not boxes[k]]
        assert flat[k] == pytest.approx(flat_share(observer[:2], corners[k], [b["polygon"] for b in others]), abs=1e-6)
        assert surface[k] == pytest.approx(
            surface_share(observer, prism(boxes[k]), [prism(b) for b in others], azimuths=1500), abs=ERROR
        )


def agree_with_the_oracle(
    boxes: Sequence[tuple[float, ...]], observer: Sequence[float], targets: Sequence[int], static: Sequence[dict] = ()
) -> np.ndarray:
    """Some boxes (x, y, yaw, length, width, bottom, top) are seen as by the oracle; gives their `surface` shares."""
    footprints = [rectangle(x, y, length, width, yaw) for x, y, yaw, length, width, _, _ in boxes]
    walls = make_statics(
        [wall["polygon"] for wall in static],
        [wall["z0"] for wall in static],
        [wall["z1"] - wall["z0"] for wall in static],
    )
    flat, surface = (shares(one_list(boxes), observer, walls, flat=each) for each in (True, False))
    for k in targets:
        others = [j for j in range(len(boxes)) if j != k]
        solids = [prism(wall) for wall in static]
        assert flat[k] == pytest.approx(
            flat_share(observer[:2], footprints[k], [footprints[j] for j in others], [each[0] for each in solids]),
            abs=1e-6,
        ), f"flat, {k}"
        prisms = [(footprints[j], *boxes[j][5:]) for j in [k, *others]]
        assert surface[k] == pytest.approx(
            surface_share(observer, prisms[0], prisms[1:], azimuths=1500, solids=solids), abs=ERROR
        ), f"surface, {k}"
    return surface[list(targets)]


KINDS = ((4.5, 1.9, 1.5), (10.0, 2.5, 3.5), (0.5, 0.5, 1.8))


@pytest.mark.long
@pytest.mark.parametrize(("seed", "height_m"), [(0, 1.8), (1, 5.0), (2, 5.0), (3, 12.0)])
def test_hundreds_in_a_disc_agree_with_the_oracle(seed: int, height_m: float) -> None:
    """Many hide one: most are hidden by several together, some stand in one another, the unit is among them."""
    rng, count = np.random.default_rng(seed), 400
    radius, angle = 70 * np.sqrt(rng.uniform(0.01, 1, count)), rng.uniform(-np.pi, np.pi, count)
    sizes = [KINDS[k] for k in rng.choice(3, count, p=[0.5, 0.1, 0.4])]
    yaw = rng.uniform(-np.pi, np.pi, count)
    boxes = [
        (r * math.cos(a), r * math.sin(a), turn, length, width, 0.0, height)
        for r, a, turn, (length, width, height) in zip(radius, angle, yaw, sizes, strict=True)
    ]
    found = agree_with_the_oracle(boxes, (0.3, 0.2, height_m), range(0, count, 16))
    assert (found == 0).any()
    assert ((found > 0.01) & (found < 0.99)).any()


def test_rows_and_rings_round_a_unit_agree_with_the_oracle() -> None:
    """Touching boxes in two closed rings, and pairs at the same bearings beyond, where azimuths begin again, too."""
    boxes: list[tuple[float, ...]] = []
    for radius_m, top_m in ((6.0, 1.2), (9.0, 1.5)):
        count = 24
        width_m = 2 * (radius_m - 0.5) * math.tan(math.pi / count)  # neighbours touch at their inner corners
        for k in range(count):
            a = -math.pi + 2 * math.pi * k / count
            boxes.append((radius_m * math.cos(a), radius_m * math.sin(a), a, 1.0, width_m, 0.0, top_m))
    for k in range(60):
        a = -math.pi + 2 * math.pi * k / 60
        for radius_m, top_m in ((20.0, 1.0 + k % 3), (23.0, 2.5), (26.0, 3.5)):
            boxes.append((radius_m * math.cos(a), radius_m * math.sin(a), a, 2.0, 1.0 + k % 2, 0.0, top_m))
    wall = {"polygon": rectangle(-14.0, 0.0, 0.3, 6.0), "z0": 0.0, "z1": 2.2}
    for height_m in (1.6, 4.0):
        found = agree_with_the_oracle(boxes, (0.0, 0.0, height_m), range(0, len(boxes), 10), [wall])
        assert np.ptp(found) > 0.5


def test_a_parking_lot_agrees_with_the_oracle() -> None:
    """Rows of equal boxes that touch: equal slopes, corners at the same azimuths, seen along a row and from aside."""
    boxes = [(5.0 * i, 2.0 * j, 0.0, 5.0, 2.0, 0.0, 1.5) for i in range(12) for j in range(-8, 9)]
    for observer in ((-7.5, 0.0, 1.8), (-7.5, 1.0, 3.0), (-2.5 - 1e-3, 0.0, 6.0), (70.0, 0.0, 4.0)):
        agree_with_the_oracle(boxes, observer, range(0, len(boxes), 22))


@pytest.mark.long
@pytest.mark.skipif(not DATA.is_dir(), reason="shared/data with recordings is not beside the project")
@pytest.mark.parametrize("name", ["nuscenes_scene0061", "av2_3b3570b4"])
def test_a_recording_agrees_with_the_oracle(name: str) -> None:
    recording = read_log(DATA / f"{name}.mcap", name=name)
    truth, ego = recording.truth, recording.scene.ego_ix
    corners, checked = box_corners(truth), 0
    order, bounds = truth.by_frame
    for frame in range(0, len(truth.stamp_ns), 40):
        rows = order[bounds[frame] : bounds[frame + 1]]
        mine = rows[truth.row_object_ix[rows] == ego][0]
        place = (truth.x_m[0, mine], truth.y_m[0, mine], truth.z_m[0, mine] - truth.height_m[0, mine] / 2 + 1.8)
        world = one_list([
            (*(getattr(truth, c)[0, r] for c in ("x_m", "y_m", "yaw_rad", "length_m", "width_m")),
             truth.z_m[0, r] - truth.height_m[0, r] / 2, truth.z_m[0, r] + truth.height_m[0, r] / 2)
            for r in rows
        ])  # fmt: skip
        carrier = int(np.flatnonzero(rows == mine)[0])
        flat, surface = (shares(world, place, flat=f, carrier=carrier) for f in (True, False))
        others = [r for r in rows if r != mine]
        for k, r in enumerate(rows):
            if r == mine or np.hypot(truth.x_m[0, r] - place[0], truth.y_m[0, r] - place[1]) > 60:
                continue
            bodies = [
                (corners[o], truth.z_m[0, o] - truth.height_m[0, o] / 2, truth.z_m[0, o] + truth.height_m[0, o] / 2)
                for o in others
                if o != r
            ]
            target = (
                corners[r],
                world.z_m[0, k] - world.height_m[0, k] / 2,
                world.z_m[0, k] + world.height_m[0, k] / 2,
            )
            assert flat[k] == pytest.approx(flat_share(place[:2], corners[r], [b[0] for b in bodies]), abs=ERROR)
            assert surface[k] == pytest.approx(surface_share(place, target, bodies, azimuths=800), abs=ERROR)
            checked += 1
    assert checked > 100


@pytest.mark.skipif(not DATA.is_dir(), reason="shared/data with recordings is not beside the project")
def test_highway_merge_gives_the_published_table() -> None:
    """The worked example of omega-prime-visibility's README, on its own recording."""
    recording = read_log(DATA / "highway_merge.mcap", name="highway_merge")
    truth, scene = recording.truth, recording.scene
    wall = make_statics([np.array([(-220, 10), (-120, 10), (-120, 0), (-220, 0)])], [0.0], [1.0])
    ego = np.flatnonzero(truth.row_object_ix == scene.ego_ix)
    place = np.stack([truth.x_m[0, ego], truth.y_m[0, ego], np.full(len(ego), 1.8)], axis=-1)[None]
    there = np.ones((1, len(ego)), dtype=bool)
    share = visible_shares(truth, wall, Observers(place, there, np.array([scene.ego_ix])), Flat())[0]

    def shares_at(frame: int) -> dict[str, float]:
        rows = np.flatnonzero(truth.frame_ix == frame)
        return {scene.object_ids[truth.row_object_ix[r]]: share[r] for r in rows}

    for frame, expected in ((0, 0.42), (1, 0.525), (2, 0.63), (3, 0.74)):
        assert shares_at(frame)["1"] == pytest.approx(expected, abs=0.0051)
        assert [shares_at(frame)[k] for k in "2345"] == [0, 0, 0, 0]
    assert [shares_at(432)[k] for k in "345"] == [1, 0, 0]


def test_over_a_low_wall() -> None:
    """Observer 1 m up, a wall 1 m high half way: of a box 2 m high the lower metre is hidden. 2 m up: nothing is."""
    world = one_list([(10.5, 0, 0, 1, 1, 0, 2), (5, 0, 0, 0.01, 20, 0, 1)])
    assert shares(world, (0, 0, 1), flat=False)[0] == pytest.approx(0.5, abs=1e-3)
    assert shares(world, (0, 0, 2), flat=False)[0] == pytest.approx(1.0, abs=2e-3)
    assert shares(world, (0, 0, 1), flat=True)[0] == 0


def test_a_bridge_hides_from_above() -> None:
    """Eyes on the ground at 0 m; a beam from 1 m up, 5 m away, hides what is above 2 m at 10 m: half of 4 m."""
    world = one_list([(10.5, 0, 0, 1, 1, 0, 4), (5, 0, 0, 0.001, 20, 1, 9)])
    assert shares(world, (0, 0, 0), flat=False)[0] == pytest.approx(0.5, abs=1e-3)


def test_carrier_neither_hides_nor_is_seen() -> None:
    world = one_list([(0, 0, 0, 4, 2, 0, 3), (10, 0, 0, 1, 1, 0, 2)])
    seen = shares(world, (-3, 0, 1), flat=False, carrier=0)  # behind its own carrier's box
    assert np.isnan(seen[0])
    assert seen[1] == 1
    assert shares(world, (-3, 0, 1), flat=True)[1] == 0


def test_inside_overlapping_and_touching() -> None:
    target = (10, 0, 0, 2, 2, 0, 2)
    assert shares(one_list([target]), (10.5, 0, 1), flat=False)[0] == 1, "inside the target sees all of it"
    around = one_list([target, (0, 0, 0, 4, 4, 0, 3)])
    assert shares(around, (0, 0, 1), flat=False)[0] == 1, "the body around the unit is ignored"
    overlapping = one_list([target, (8.5, 0, 0, 2, 8, 0, 3)])
    assert shares(overlapping, (0, 0, 1), flat=False)[0] == 1, "an overlapping body does not hide"
    touching = one_list([target, (8, 0, 0, 2, 8, 0, 3)])
    assert shares(touching, (0, 0, 1), flat=False)[0] == 0, "a touching one does"


def test_an_obstacle_that_reaches_into_the_target_hides_where_it_begins_first() -> None:
    """An L of two wings, one reaches into the target: both wings hide it, as they hide another that they do not touch.

    A wing that begins in line with the target's face hides nothing. One that begins .1 m before it, at 8.9 m, hides the
    half metre to either side of the line of sight.
    """
    ell = np.array([(4, -6), (5, -6), (5, 4), (9.5, 4), (9.5, 5), (4, 5)], dtype=float)
    world = one_list([(10, 4.5, 0, 2, 2, 0, 2), (10, 0, 0, 1, 1, 0, 2)])
    assert shares(world, (0, 0, 1), make_statics([ell], [0.0], [5.0]), flat=False).tolist() == [0, 0]

    def seen(begins_m: float) -> list[float]:
        wing = np.array([(begins_m, 4), (9.5, 4), (9.5, 5), (begins_m, 5)])
        return [shares(world, (0, 4.5, 1), make_statics([wing], [0.0], [5.0]), flat=flat)[0] for flat in (True, False)]

    assert seen(9.0) == [1, 1]
    half = math.atan(1 / 9)
    assert seen(8.9) == pytest.approx([1 - math.atan(0.5 / 8.9) / half] * 2, abs=1e-6)


def rectangles_at_random(
    rng: np.random.Generator, count: int, spans: Sequence[tuple[float, float]]
) -> list[np.ndarray]:
    """Rectangles with x, y, length and width from these spans."""
    return [rectangle(*(rng.uniform(*span) for span in spans), rng.uniform(0, 3)) for _ in range(count)]


def against_rays(
    target: np.ndarray, solids: Sequence[np.ndarray], heights: Sequence[tuple[float, float]], eye: Sequence[float]
) -> tuple[float, float]:
    """By how much the shares of a target 1.7 m high differ from those by 8,000 rays, with heights and without."""
    (c0, c1, c2, _), middle = target, target.mean(axis=0)
    pose = (*middle, np.arctan2(*(c0 - c1)[::-1]), np.hypot(*(c0 - c1)), np.hypot(*(c1 - c2)), 0.0, 1.7)
    static = make_statics(solids, [z0 for z0, _ in heights], [z1 - z0 for z0, z1 in heights])
    surface, flat = (shares(one_list([pose]), eye, static, flat=flat)[0] for flat in (False, True))
    prisms = [(solid, z0, z1) for solid, (z0, z1) in zip(solids, heights, strict=True)]
    by_rays = surface_share(eye, (target, 0.0, 1.7), [], azimuths=8000, solids=prisms)
    return surface - by_rays, flat - flat_share(eye[:2], target, [], solids)


def test_solids_in_and_around_the_target_agree_with_rays() -> None:
    """150 scenes. In most of them an outline crosses that of the target: boxes would hide nothing there."""
    rng, crossed = np.random.default_rng(3), 0
    for _ in range(150):
        [target] = rectangles_at_random(rng, 1, [(30, 30), (0, 0), (0.5, 5), (0.5, 2)])
        solids = rectangles_at_random(rng, int(rng.integers(1, 4)), [(26, 33), (-2, 2), (0.3, 6), (0.3, 3)])
        heights = [(z0, z0 + rng.uniform(0.3, 3)) for z0 in rng.choice([0.0, 0.0, 1.0], len(solids))]
        off = against_rays(target, solids, heights, (0.0, 0.0, float(rng.choice([1.5, 5.0]))))
        assert off == pytest.approx((0, 0), abs=2e-4)
        crossed += any(shapely.Polygon(solid).intersects(shapely.Polygon(target)) for solid in solids)
    assert crossed > 90


def test_units_over_solids_agree_with_rays() -> None:
    """100 scenes: the unit is .1 to 4 m above the one or two roofs it stands over, or beside which it stands."""
    rng, over = np.random.default_rng(5), 0
    for _ in range(100):
        solids = rectangles_at_random(rng, int(rng.integers(1, 3)), [(-2, 2), (-1, 1), (5, 14), (4, 9)])
        [target] = rectangles_at_random(rng, 1, [(9, 30), (-5, 5), (0.5, 5), (0.5, 2)])
        heights = [(0.0, rng.uniform(2, 5)) for _ in solids]
        surface, _flat = against_rays(target, solids, heights, (0.0, 0.0, rng.uniform(5.1, 9)))
        assert surface == pytest.approx(0, abs=2e-4)
        over += shapely.Polygon(solids[0]).contains(shapely.Point(0, 0))
    assert over > 80


@pytest.mark.parametrize("x_m", [7.0, 9.0, 12.0, 16.0, 20.0])
def test_a_gantry_does_not_look_through_the_truck_below_it(x_m: float) -> None:
    """6 m over a truck 12 m long and 4 m high: its front edge lets pass what is above 6 − 2·x/6 at the distance x."""
    world = one_list([(0, 0, 0, 12, 2.5, 0, 4), (x_m, 0, 0, 0.001, 0.5, 0, 1.75)])
    above_m = np.clip(6 - 2 * x_m / 6, 0, 1.75)
    assert shares(world, (0, 0, 6), flat=False)[1] == pytest.approx(1 - above_m / 1.75, abs=1e-3)
    assert find_blockers(world, NO_STATICS, at((0, 0, 6)), Surface())[0].tolist() == [-1, 0 if above_m > 0 else -1]
    for inside in ((0, 0, 3.9), (0, 0, 4.0), (0, 0, 4.005)):
        assert shares(world, inside, flat=False)[1] == 1, "on its top, as on that of a mast of the log, is in it"
    assert shares(world, (0, 0, 6), flat=True)[1] == 1, "bodies without end have nothing above them"


def test_under_a_deck_what_is_above_its_far_edge_is_hidden() -> None:
    """1 m up under a deck 2 m up that ends at 5 m: at 10 m all above 1 + 1·10/5 = 3 m of 4."""
    world = one_list([(0, 0, 0, 10, 10, 2, 3), (10, 0, 0, 0.001, 0.5, 0, 4)])
    assert shares(world, (0, 0, 1), flat=False)[1] == pytest.approx(0.75, abs=1e-3)


def test_a_unit_on_a_wall_or_a_roof_has_it_before_it() -> None:
    """On the face of a house, at its corner, and on its roof: what is behind it is hidden, what is before it is not."""
    house = make_statics([np.array([(0, -10), (20, -10), (20, 10), (0, 10)])], [0.0], [12.0])
    world = one_list([(30, 0, 0, 1, 1, 0, 2), (-30, 0, 0, 1, 1, 0, 2), (-30, -30, 0, 1, 1, 0, 2)])
    for place in ((0, 0, 6), (-1e-9, 0, 6), (1e-9, 0, 6), (0, -10, 6)):
        assert shares(world, place, house, flat=False).tolist() == [0, 1, 1]
        assert shares(world, place, house, flat=True).tolist() == [0, 1, 1]
    assert shares(world, (10, 0, 12), house, flat=False).tolist() == [0, 0, 0], "flat on the roof nobody sees over it"
    assert shares(world, (0, 0, 12), house, flat=False).tolist() == [0, 1, 1], "but over its edge"


def test_a_person_who_steps_from_behind_a_corner() -> None:
    """The ego comes at 10 m/s, a pedestrian walks at 1.5 m/s out from behind a house, listed with its visible share.

    Seconds unknown grow as the house is moved on, step by step: there is no place at which they fall to none.
    """

    def unknown_s(east_m: float) -> float:
        west, east = east_m - 30, east_m + 3
        house = make_statics([np.array([(west, 5), (east, 5), (east, 30), (west, 30)])], [0.0], [8.0])
        left, total = 1.0, 0.0
        for k in range(80):
            t = k / 10
            person = one_list([(6, 16 - 1.5 * t, -np.pi / 2, 0.5, 0.5, 0, 1.75)])
            left *= 1 - shares(person, (-70 + 10 * t, 0, 1.6), house, flat=False)[0]
            total += 0.1 * left
        return total

    found = [unknown_s(east_m) for east_m in (0, 2, 2.74, 2.76, 3, 4)]
    assert found == pytest.approx([6.360, 6.861, 7.145, 7.152, 7.225, 7.247], abs=2e-3)


@given(turn=st.floats(-np.pi, np.pi), scale=st.floats(0.5, 3), east=st.floats(-1e5, 1e5), seed=st.integers(0, 99))
def test_turning_scaling_and_moving_the_world_changes_nothing(
    turn: float, scale: float, east: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    n = 8
    boxes = np.column_stack([
        rng.uniform(-20, 20, (n, 2)), rng.uniform(-3, 3, n), rng.uniform(0.5, 6, n), rng.uniform(0.5, 3, n),
        np.zeros(n), rng.uniform(1, 4, n),
    ])  # fmt: skip
    c, s = np.cos(turn), np.sin(turn)
    moved = boxes * [scale, scale, 1, scale, scale, scale, scale]
    moved[:, :2] = moved[:, :2] @ [[c, s], [-s, c]] + [east, 0]
    moved[:, 2] += turn
    place = np.array([30.0, 30.0, 1.7])
    there = np.array([*(place[:2] * scale @ [[c, s], [-s, c]] + [east, 0]), place[2] * scale])
    for flat in (True, False):
        before, after = shares(one_list(boxes), place, flat=flat), shares(one_list(moved), there, flat=flat)
        # Whether boxes overlap or only touch may turn on rounding; random boxes do neither by a hair.
        np.testing.assert_allclose(after, before, atol=1e-5)


def test_rectangle_and_box_corners_agree() -> None:
    world = one_list([(3, 4, 0.7, 4, 2, 0, 1)])
    ours, theirs = box_corners(world)[0], rectangle(3, 4, 4, 2, 0.7)
    assert {tuple(np.round(c, 9)) for c in ours} == {tuple(np.round(c, 9)) for c in theirs}


def test_who_hides_whom() -> None:
    """Seen from 1 m: a truck hides the far box wholly, a low box in front of it half; a house hides another."""
    world = one_list(
        [
            (30, 0, 0, 1, 1, 0, 2),  # hidden by both that follow, more by the truck
            (10, 0, 0, 1, 20, 0, 1),
            (20, 0, 0, 2, 20, 0, 4),
            (0, 30, 0, 1, 1, 0, 2),  # behind the house
            (-30, 0, 0, 1, 1, 0, 2),  # free
        ]
    )
    house = make_statics([np.array([(-5, 10), (5, 10), (5, 12), (-5, 12)])], [0.0], [9.0])
    assert find_blockers(world, house, at((0, 0, 1)), Surface())[0].tolist() == [2, -1, 1, -2, -1]


@pytest.mark.parametrize("side", [1, -1])
def test_a_wall_from_far_behind_to_the_front_hides_what_is_ahead(side: int) -> None:
    """Half a metre beside the eyes, from 100 m behind to 10 m ahead, where it leaves 0.05 of slope to its side.

    Of what is 20 m ahead, from 7 m on the other side to 3 m on its own, all is seen to where the wall begins. Its own
    middle is behind, on the other side of the line that azimuths are counted from.
    """
    world = one_list([(20, -2 * side, 0, 0.001, 10, 0, 2), (-45, side, 0, 110, 1, 0, 9)])
    seen, wall = shares(world, (0, 0, 1), flat=True)
    free, hidden = math.atan(7 / 20) + math.atan(0.05), math.atan(3 / 20) - math.atan(0.05)
    assert seen == pytest.approx(free / (free + hidden), abs=1e-3)
    assert wall == 1
    assert find_blockers(world, NO_STATICS, at((0, 0, 1)), Flat())[0].tolist() == [1, -1]


def star(rng: np.random.Generator, corners: int) -> shapely.Polygon:
    """A polygon around the origin, mostly not convex, with a courtyard."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    outer = shapely.Polygon(rng.uniform(5, 20, corners)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return outer.difference(shapely.box(-1.5, -1, 1, 2))


def test_convex_parts_cover_a_polygon_and_leave_its_holes() -> None:
    rng, triangles, parts = np.random.default_rng(7), 0, 0
    for _ in range(60):
        polygon = star(rng, int(rng.integers(5, 30)))
        if polygon.geom_type != "Polygon":
            continue
        cut = [shapely.Polygon(part) for part in cut_convex(polygon)]
        for part in cut:
            assert part.exterior.is_ccw
            assert part.convex_hull.area - part.area <= 1e-9 * part.area
        assert sum(part.area for part in cut) == pytest.approx(polygon.area, rel=1e-9)  # none over another
        assert shapely.union_all(cut).symmetric_difference(polygon).area <= 1e-9 * polygon.area
        triangles += len(shapely.constrained_delaunay_triangles(polygon).geoms)
        parts += len(cut)
    assert parts < 0.7 * triangles


def test_a_house_with_a_courtyard_hides_as_its_halves_do_by_rays() -> None:
    """Also from the courtyard, where a unit is not inside the house."""
    house = shapely.box(-8, -8, 8, 8).difference(shapely.box(-3, -4, 4, 3))
    halves = [np.array(house.intersection(shapely.box(*half)).exterior.coords)[:-1]
              for half in ((-8, -8, 0.5, 8), (0.5, -8, 8, 8))]  # fmt: skip
    target = rectangle(30, 5, 5, 2, 0.3)
    world = one_list([(30, 5, 0.3, 5, 2, 0, 2)])
    static = make_statics([house], [0.0], [3.0])
    for eye in ((-20, -6, 1.5), (0, 0, 1.5), (0, 0, 2.9), (-12, 3, 6), (1, 1, 14), (5, -20, 2)):
        by_rays = surface_share(eye, (target, 0.0, 2.0), [], azimuths=8000, solids=[(h, 0.0, 3.0) for h in halves])
        assert shares(world, eye, static, flat=False)[0] == pytest.approx(by_rays, abs=2e-4)
    assert shares(world, (0, 0, 1.5), static, flat=False)[0] == 0


def test_solids_and_log_moved_together_are_seen_alike() -> None:
    rng, turn, shift = np.random.default_rng(11), 0.7, np.array([300.0, -120.0])
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    for _ in range(30):
        house = shapely.affinity.translate(star(rng, 9), 25, 0)
        if house.geom_type != "Polygon":
            continue
        there = shapely.transform(house, lambda xy: xy @ matrix + shift)
        eye = np.array([-5.0, rng.uniform(-9, 9)])
        (x, y), (u, v) = (60.0, rng.uniform(-9, 9)), eye @ matrix + shift
        p, q = np.array([x, y]) @ matrix + shift
        here = shares(one_list([(x, y, 0.2, 4, 2, 0, 2)]), (*eye, 6), make_statics([house], [0], [5]), flat=False)
        moved = shares(
            one_list([(p, q, 0.2 + turn, 4, 2, 0, 2)]), (u, v, 6), make_statics([there], [0], [5]), flat=False
        )
        assert moved == pytest.approx(here, abs=1e-9)


def test_what_a_unit_sees_of_a_house_does_not_depend_on_where_it_was_before() -> None:
    """A unit that stands, goes away and comes back, and units that are there for one list each."""
    world = read_log(Path(__file__).parents[2] / "logs/crossing.mcap", name="crossing").truth
    lists, frames = 9, len(world.stamp_ns)
    house = make_statics([shapely.box(-9, -9, 9, 9).difference(shapely.box(-1, -1, 1, 1))], [0.0], [5.0])
    place_m = np.zeros((1, frames, 3))
    place_m[0, :] = (-14.0, -12.0, 4.0)
    place_m[0, 4:6] = (14.0, -12.0, 6.0)
    once = np.zeros((lists, frames), dtype=bool)
    once[np.arange(lists), np.arange(lists)] = True
    [one] = visible_shares(world, house, Observers(place_m, once.any(axis=0)[None], np.array([-1])), Surface())
    each = visible_shares(
        world, house, Observers(np.repeat(place_m, lists, axis=0), once, np.full(lists, -1)), Surface()
    )
    row = np.flatnonzero(world.frame_ix < lists)
    assert np.array_equal(one[row], each[world.frame_ix[row], row])
    assert len(np.unique(one[row])) > 5


def test_polygons_made_together_are_those_made_one_by_one() -> None:
    """Byte for byte, with holes and without; and a solid that is convex is its own only part."""
    rng, square, yard = np.random.default_rng(3), ((-9, -9), (9, -9), (9, 9), (-9, 9)), ((-1, -1), (1, -1), (1, 1))
    solids = [Solid("yard", square, 0.0, 3.0, holes_m=(yard,))]
    for count in range(3, 20):
        angle = np.sort(rng.uniform(0, 2 * np.pi, count))
        ring = rng.uniform(5, 20, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        solids.append(Solid("star", tuple((x, y) for x, y in ring.tolist()), 0.0, 3.0))
    solids.append(Solid("square", square[::-1], 0.0, 3.0))
    assert [one.wkb for one in outline_solids(solids)] == [solid.outline.wkb for solid in solids]
    assert len(outline_solids([])) == 0
    static = make_statics(outline_solids(solids), [0.0] * len(solids), [3.0] * len(solids))
    assert [(static.body == k).sum() for k in (1, len(solids) - 1)] == [1, 1]
    assert {(x, y) for x, y in static.xy_m[static.start[-2] :].tolist()} == {*square}
    assert (static.body == 0).sum() > 1
