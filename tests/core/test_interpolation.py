"""States between frames: by hand, and against a plain oracle that takes one object and one instant at a time."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.core.interpolation import (
    interpolate_at_instants,
    interpolate_at_stated_instants,
    interpolate_states,
    wrap_angles,
)
from copem_replay.core.tracks import TRUTH, VALUES, Tracks
from tests.helpers.scenes import T0_NS

MS = 1_000_000
MAX_GAP_S = 0.5


@dataclass(frozen=True)
class Sighting:
    """One object in one frame: nanoseconds since the log's start, and the nine values in the order of VALUES."""

    at_ns: int
    values: tuple[float, ...]


def sighting(at_ns: int, **values: float) -> Sighting:
    """Values that are not said are 0; every box is 1 m each way."""
    return Sighting(at_ns, tuple(values.get(name, 1.0 if name.endswith(("th_m", "ht_m")) else 0.0) for name in VALUES))


def truth(objects: dict[int, list[Sighting]], frames_ns: list[int] | None = None) -> Tracks:
    """The world as recorded: `objects` by their index, each with its sightings in order."""
    frames = sorted({s.at_ns for seen in objects.values() for s in seen} | set(frames_ns or []))
    rows = [s for seen in objects.values() for s in seen]
    captured_s = np.array(frames, dtype=float) * 1e-9
    columns: dict[str, Any] = {name: np.array([[s.values[k] for s in rows]]) for k, name in enumerate(VALUES)}
    return Tracks(
        units=(TRUTH,),
        start=np.cumsum([0, *(len(seen) for seen in objects.values())]),
        unit_ix=np.zeros(len(objects), dtype=int),
        object_ix=np.array(list(objects), dtype=int),
        frame_ix=np.array([frames.index(s.at_ns) for s in rows], dtype=int),
        stamp_ns=T0_NS + np.array(frames, dtype=np.int64),
        captured_s=captured_s,
        frame_unit_ix=np.zeros(len(frames), dtype=int),
        arrives_s=captured_s[None],
        valid=np.ones((1, len(rows)), dtype=bool),
        **columns,
    )


def turn(a: float, b: float) -> float:
    """The short way round from a to b."""
    difference = math.fmod(b - a, 2 * math.pi)
    if difference > math.pi:
        difference -= 2 * math.pi
    if difference < -math.pi:
        difference += 2 * math.pi
    return difference


def plain(seen: list[Sighting], at_ns: int) -> dict[str, float] | None:
    """What one object does at one instant, told in the contract's words; None where it is absent."""
    for s in seen:
        if abs(s.at_ns - at_ns) <= 1_000:
            return dict(zip(VALUES, s.values, strict=True))
    for a, b in itertools.pairwise(seen):
        if a.at_ns < at_ns < b.at_ns:
            if b.at_ns - a.at_ns > 500 * MS:
                return None
            share = (at_ns - a.at_ns) / (b.at_ns - a.at_ns)
            state = {n: v + share * (w - v) for n, v, w in zip(VALUES, a.values, b.values, strict=True)}
            yaw_a, yaw_b = a.values[VALUES.index("yaw_rad")], b.values[VALUES.index("yaw_rad")]
            return state | {"yaw_rad": yaw_a + share * turn(yaw_a, yaw_b)}
    return None


def same(found: dict[str, float], expected: dict[str, float]) -> None:
    for name in VALUES:
        if name == "yaw_rad":
            assert abs(turn(found[name], expected[name])) < 1e-9
        else:
            assert found[name] == pytest.approx(expected[name], abs=1e-9)


def at(world: Tracks, t_ns: int, object_ix: int = 0) -> dict[str, float] | None:
    """`states_at` of one object at one instant."""
    columns, there = interpolate_states(
        world, np.array([object_ix]), np.array([t_ns * 1e-9]), t0_ns=T0_NS, max_gap_s=MAX_GAP_S
    )
    assert set(columns) == set(VALUES)
    assert all(np.isnan(column[0]) != there[0] for column in columns.values())
    return {name: float(column[0]) for name, column in columns.items()} if there[0] else None


def in_lists(world: Tracks, stamps_ns: list[int]) -> list[dict[int, dict[str, float]]]:
    """`at_instants`, list by list: the objects in it and their states."""
    return by_list(
        interpolate_at_instants(world, T0_NS + np.array(stamps_ns, dtype=np.int64), t0_ns=T0_NS, max_gap_s=MAX_GAP_S),
        stamps_ns,
    )


def by_list(found: Tracks, stamps_ns: list[int]) -> list[dict[int, dict[str, float]]]:
    """List by list the objects in it and their states."""
    assert found.stamp_ns.tolist() == [T0_NS + t for t in stamps_ns]
    assert found.captured_s == pytest.approx([t * 1e-9 for t in stamps_ns], abs=1e-12)
    assert np.array_equal(found.arrives_s, found.captured_s[None])
    assert found.valid.all()
    result: list[dict[int, dict[str, float]]] = [{} for _ in stamps_ns]
    for e, object_ix in enumerate(found.object_ix):
        rows = range(found.start[e], found.start[e + 1])
        frames = [int(found.frame_ix[p]) for p in rows]
        assert frames == sorted(set(frames)), "rows of a track in order of capture"
        for p, f in zip(rows, frames, strict=True):
            assert object_ix not in result[f]
            result[f][int(object_ix)] = {name: float(getattr(found, name)[0, p]) for name in VALUES}
    return result


class TestByHand:
    def test_a_quarter_of_the_way(self) -> None:
        """From (0, 8) at 0 s to (10, 0) at 0.4 s: at 0.1 s it is at (2.5, 6)."""
        world = truth({0: [
            sighting(0, x_m=0, y_m=8, z_m=1, vx_mps=25, vy_mps=-20, length_m=4, width_m=2, height_m=1.5),
            sighting(400 * MS, x_m=10, y_m=0, z_m=3, vx_mps=29, vy_mps=-24, length_m=4.4, width_m=1.6, height_m=1.9),
        ]})  # fmt: skip
        expected = {
            "x_m": 2.5, "y_m": 6.0, "z_m": 1.5, "yaw_rad": 0.0, "vx_mps": 26.0, "vy_mps": -21.0,
            "length_m": 4.1, "width_m": 1.9, "height_m": 1.6,
        }  # fmt: skip
        assert at(world, 100 * MS) == pytest.approx(expected)
        assert in_lists(world, [100 * MS]) == [{0: pytest.approx(expected)}]

    @pytest.mark.parametrize(
        ("before_deg", "after_deg", "half_deg"),
        [(10, 50, 30), (170, -170, 180), (-170, 170, 180), (175, -165, -175), (-175, 165, 175), (350, 10, 0),
         (-90, 80, -5), (-100, 100, 180), (720, 730, 5), (180, -180, 180), (179, 181, 180)],
    )  # fmt: skip
    def test_yaw_turns_the_short_way_round(self, before_deg: float, after_deg: float, half_deg: float) -> None:
        world = truth({0: [
            sighting(0, yaw_rad=math.radians(before_deg)), sighting(100 * MS, yaw_rad=math.radians(after_deg)),
        ]})  # fmt: skip
        found = at(world, 50 * MS)
        assert found is not None
        assert abs(turn(found["yaw_rad"], math.radians(half_deg))) < 1e-12
        assert -math.pi < found["yaw_rad"] <= math.pi
        (held,) = in_lists(world, [50 * MS])
        assert held[0]["yaw_rad"] == found["yaw_rad"]

    @pytest.mark.parametrize(("gap_ns", "bridged"), [(499_999_999, True), (500 * MS, True), (500_002_000, False)])
    def test_gaps_up_to_half_a_second_are_bridged(self, gap_ns: int, bridged: bool) -> None:
        world = truth({0: [sighting(0, x_m=0), sighting(100 * MS, x_m=1), sighting(100 * MS + gap_ns, x_m=6)]})
        middle = 100 * MS + gap_ns // 2
        found = at(world, middle)
        assert (found is not None) is bridged
        assert [bool(held) for held in in_lists(world, [50 * MS, middle, 100 * MS + gap_ns])] == [True, bridged, True]
        if found:
            assert found["x_m"] == pytest.approx(3.5, abs=1e-6)

    def test_another_longest_gap(self) -> None:
        world = truth({0: [sighting(0), sighting(200 * MS)]})
        for max_gap_s, there in ((0.19, False), (0.2, True), (3.0, True)):
            _, present = interpolate_states(world, np.array([0]), np.array([0.1]), t0_ns=T0_NS, max_gap_s=max_gap_s)
            assert present.tolist() == [there]

    @pytest.mark.parametrize("beyond_ns", [1_001, 2_000, MS, 10_000 * MS])
    def test_never_beyond_the_first_and_last_frame(self, beyond_ns: int) -> None:
        """Another object is in the log throughout, so that there are frames before and after."""
        world = truth({
            0: [sighting(-20_000 * MS), sighting(20_000 * MS)],
            1: [sighting(0, x_m=1), sighting(100 * MS, x_m=2)],
            2: [sighting(-20_000 * MS), sighting(20_000 * MS)],
        })  # fmt: skip
        for instant, there in ((-beyond_ns, False), (0, True), (100 * MS, True), (100 * MS + beyond_ns, False)):
            assert (at(world, instant, 1) is not None) is there
            assert (1 in in_lists(world, [instant])[0]) is there

    def test_within_a_microsecond_it_is_the_recorded_state_bit_for_bit(self) -> None:
        recorded = [
            Sighting(t * MS, tuple(0.1 + 0.2 * (k + 1) / (j + 3) for k in range(9)))
            for j, t in enumerate((0, 100, 233, 1900))
        ]
        world = truth({5: recorded, 7: [sighting(k * 10 * MS, x_m=k) for k in range(200)]})
        for s in recorded:
            expected = dict(zip(VALUES, s.values, strict=True))
            for off_ns in (-1_000, -999, -1, 0, 1, 999, 1_000):
                assert at(world, s.at_ns + off_ns, 5) == expected
                assert in_lists(world, [s.at_ns + off_ns])[0][5] == expected
        moved = at(world, 100 * MS + 2_000, 5)
        assert moved is not None
        assert moved["x_m"] != recorded[1].values[0]

    def test_a_single_frame_is_a_track_too(self) -> None:
        world = truth({0: [sighting(50 * MS, x_m=3)]}, frames_ns=[0, 100 * MS])
        found = in_lists(world, [0, 49 * MS, 50 * MS, 51 * MS, 100 * MS])
        assert [len(held) for held in found] == [0, 0, 1, 0, 0]

    def test_lists_of_nothing_stay_and_objects_never_there_go(self) -> None:
        world = truth({0: [sighting(0)], 1: [sighting(300 * MS), sighting(400 * MS)]})
        found = interpolate_at_instants(world, T0_NS + np.array([100 * MS, 350 * MS]), t0_ns=T0_NS, max_gap_s=0.5)
        assert found.object_ix.tolist() == [1]
        assert found.frame_ix.tolist() == [1]
        assert len(found.stamp_ns) == 2

    def test_no_instants_and_no_objects(self) -> None:
        assert in_lists(truth({0: [sighting(0), sighting(100 * MS)]}), []) == []
        empty = truth({}, frames_ns=[0, 100 * MS])
        assert in_lists(empty, [0, 50 * MS]) == [{}, {}]
        assert at(empty, 50 * MS) is None


def test_states_of_many_in_any_order() -> None:
    """Object 3 walks 1 m/s from x = 0, object 1 stands at x = 9 from 1 s to 1.4 s; object 0, 2 and 4 have no track."""
    world = truth({
        3: [sighting(k * 200 * MS, x_m=0.2 * k) for k in range(11)],
        1: [sighting(1000 * MS, x_m=9), sighting(1400 * MS, x_m=9)],
    })  # fmt: skip
    objects = np.array([3, 0, 1, 3, 1, 4, 3, 2, 1, 3, 3])
    times = np.array([1.3, 1.1, 1.1, 0.1, 0.9, 0.0, 1.3, 1.0, 1.4, 2.0, 2.1])
    expected = [1.3, None, 9.0, 0.1, None, None, 1.3, None, 9.0, 2.0, None]
    columns, there = interpolate_states(world, objects, times, t0_ns=T0_NS, max_gap_s=MAX_GAP_S)
    found = [float(x) if here else None for x, here in zip(columns["x_m"], there, strict=True)]
    assert found == pytest.approx(expected)
    columns, there = interpolate_states(world, objects[:0], times[:0], t0_ns=T0_NS, max_gap_s=MAX_GAP_S)
    assert len(there) == len(columns["x_m"]) == 0


def test_who_has_no_truth_id_is_nobody() -> None:
    """`object_ix = -1` means: no truth id."""
    assert at(truth({0: [sighting(0)], 1: [sighting(0)]}), 0, object_ix=-1) is None


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
def test_wrap(turns: int) -> None:
    angles = np.array([-3.0, -1e-9, 0.0, 1.0, 3.14])
    assert wrap_angles(angles + turns * 2 * np.pi) == pytest.approx(angles, abs=1e-12)
    assert wrap_angles(np.array([np.pi, -np.pi])).tolist() == [np.pi, np.pi], "the angle behind is π, not −π"


values = st.tuples(*[st.floats(-100, 100)] * 3, st.floats(-7, 7), *[st.floats(-30, 30)] * 2, *[st.floats(0.1, 9)] * 3)
# Steps between the frames of an object: never so near to the bounds of 1 µs and 0.5 s that rounding decides.
steps = st.one_of(st.integers(10_000, 499_990_000), st.sampled_from([500 * MS, 500_010_000, 900 * MS, 3_000 * MS]))


@st.composite
def objects(draw: st.DrawFn) -> dict[int, list[Sighting]]:
    result = {}
    for object_ix in draw(st.lists(st.integers(0, 6), unique=True, max_size=4)):
        t_ns = draw(st.integers(0, 1_500 * MS))
        seen = [Sighting(t_ns, draw(values))]
        for step in draw(st.lists(steps, max_size=6)):
            t_ns += step
            seen.append(Sighting(t_ns, draw(values)))
        result[object_ix] = seen
    return result


@settings(deadline=None)
@given(objects(), st.data())
def test_against_the_oracle(seen: dict[int, list[Sighting]], data: st.DataObject) -> None:
    frames = sorted({s.at_ns for each in seen.values() for s in each} | {0})
    near = st.builds(lambda t, off: t + off, st.sampled_from(frames), st.integers(-3_000, 3_000))
    instants = data.draw(st.lists(st.integers(0, frames[-1] + MS) | near, max_size=12))
    world = truth(seen, frames_ns=[0])
    for t_ns, held in zip(sorted(instants), in_lists(world, sorted(instants)), strict=True):
        expected = {o: state for o, each in seen.items() if (state := plain(each, t_ns)) is not None}
        assert held.keys() == expected.keys()
        for object_ix, state in expected.items():
            same(held[object_ix], state)
    asked = [(o, t) for t in instants for o in range(8)]
    columns, there = interpolate_states(
        world,
        np.array([o for o, _ in asked], dtype=int),
        np.array([t for _, t in asked], dtype=float) * 1e-9,
        t0_ns=T0_NS,
        max_gap_s=MAX_GAP_S,
    )
    for k, (object_ix, t_ns) in enumerate(asked):
        known = plain(seen[object_ix], t_ns) if object_ix in seen else None
        assert there[k] == (known is not None)
        if known is not None:
            same({name: float(column[k]) for name, column in columns.items()}, known)


@settings(deadline=None)
@given(st.lists(st.sets(st.integers(0, 11), max_size=8), max_size=3), st.sets(st.integers(0, 11)), st.data())
def test_some_of_the_truths_own_frames(missed: list[set[int]], asked: set[int], data: st.DataObject) -> None:
    """Ten frames a second, of which objects miss any or none: up to four in a row are filled, more are a gap."""
    seen = {
        o: [Sighting(k * 100 * MS, data.draw(values)) for k in range(12) if k not in frames]
        for o, frames in enumerate(missed)
    }
    world, instants = truth(seen, frames_ns=[k * 100 * MS for k in range(12)]), [k * 100 * MS for k in sorted(asked)]
    found = interpolate_at_instants(world, T0_NS + np.array(instants, dtype=np.int64), t0_ns=T0_NS, max_gap_s=MAX_GAP_S)
    for t_ns, held in zip(instants, by_list(found, instants), strict=True):
        expected = {o: state for o, each in seen.items() if (state := plain(each, t_ns)) is not None}
        assert held.keys() == expected.keys()
        for object_ix, state in expected.items():
            same(held[object_ix], state)


@pytest.mark.parametrize("asked", [None, [0, 100, 200, 300]])
def test_a_frame_that_one_object_misses_is_filled_at_the_truths_own_instants(asked: list[int] | None) -> None:
    """Object 1 is not in the frame of 100 ms, in which object 2 is: it was half way, and so it is there."""
    world = truth(
        {
            1: [sighting(0, x_m=0.0), sighting(200 * MS, x_m=2.0), sighting(300 * MS, x_m=3.0)],
            2: [sighting(k * 100 * MS, x_m=50.0) for k in range(4)],
        }
    )
    instants = world.stamp_ns if asked is None else T0_NS + np.array(asked) * MS
    found = interpolate_at_instants(world, instants, t0_ns=T0_NS, max_gap_s=MAX_GAP_S)
    rows = found.row_object_ix == 1
    assert found.frame_ix[rows].tolist() == [0, 1, 2, 3]
    assert found.x_m[0, rows] == pytest.approx([0, 1, 2, 3])
    assert (found.row_object_ix == 2).sum() == 4


def stated(world: Tracks, told: list[tuple[int, int, int]]) -> list[dict[int, dict[str, float]]]:
    """`at_stated_instants`, list by list. `told`: the stated instant, the earliest and the latest capture."""
    stamps, earliest, latest = (T0_NS + np.array(column, dtype=np.int64) for column in zip(*told, strict=True))
    found = interpolate_at_stated_instants(world, stamps, (earliest, latest), t0_ns=T0_NS, max_gap_s=MAX_GAP_S)
    return by_list(found, [at_ns for at_ns, _, _ in told])


class TestStatedInstants:
    def test_the_first_state_moved_back_and_the_last_moved_on(self) -> None:
        """(50, 8) with (−10, 2) m/s at 1 s, (40, 10) with (−12, 1) m/s at 1.4 s: 40 ms earlier and 30 ms later."""
        box = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "z_m": 0.75}
        world = truth({0: [
            sighting(1000 * MS, x_m=50, y_m=8, vx_mps=-10, vy_mps=2, yaw_rad=3.0, **box),
            sighting(1400 * MS, x_m=40, y_m=10, vx_mps=-12, vy_mps=1, yaw_rad=3.1, **box),
        ]})  # fmt: skip
        before, after = stated(world, [(960 * MS, 1000 * MS, 1000 * MS), (1430 * MS, 1400 * MS, 1400 * MS)])
        assert before[0] == pytest.approx(box | {"x_m": 50.4, "y_m": 7.92, "vx_mps": -10, "vy_mps": 2, "yaw_rad": 3.0})
        assert after[0] == pytest.approx(box | {"x_m": 39.64, "y_m": 10.03, "vx_mps": -12, "vy_mps": 1, "yaw_rad": 3.1})

    @pytest.mark.parametrize(
        ("told_ms", "captured_ms", "x_m"),
        [(500, 1000, 5.0), (499, 1000, None), (960, 990, None), (960, 1100, 9.6), (1200, 990, 12.0),
         (2500, 2000, 25.0), (2501, 2000, None), (2030, 2010, None)],
    )  # fmt: skip
    def test_up_to_the_longest_gap_and_only_who_was_there_at_the_capture(
        self, told_ms: int, captured_ms: int, x_m: float | None
    ) -> None:
        """From 1 s to 2 s an object drives at 10 m/s, 10 m to the east of the origin at 1 s."""
        world = truth({0: [sighting(k * 100 * MS, x_m=k, vx_mps=10) for k in range(10, 21)]})
        [found] = stated(world, [(told_ms * MS, captured_ms * MS, captured_ms * MS)])
        assert [state["x_m"] for state in found.values()] == ([] if x_m is None else [pytest.approx(x_m)])

    def test_in_a_gap_the_nearer_end_counts(self) -> None:
        """Away from 1 s to 1.6 s: until half of it moved on, then moved back; lists of both ends state each instant."""
        world = truth({0: [sighting(1000 * MS, x_m=0, vx_mps=1), sighting(1600 * MS, x_m=50, vx_mps=2)]})
        found = stated(world, [(at * MS, 1000 * MS, 1600 * MS) for at in (1250, 1300, 1350)])
        assert [one[0]["x_m"] for one in found] == pytest.approx([0.25, 0.3, 49.5])


@settings(deadline=None)
@given(objects(), st.data())
def test_stated_instants_against_the_oracle(seen: dict[int, list[Sighting]], data: st.DataObject) -> None:
    frames = sorted({s.at_ns for each in seen.values() for s in each} | {0})
    near = st.builds(lambda t, off: t + off, st.sampled_from(frames), st.integers(-3_000, 3_000))
    instant = st.integers(-600 * MS, frames[-1] + 600 * MS) | near
    told = sorted({
        at_ns: (at_ns, *sorted(data.draw(st.tuples(instant, instant))))
        for at_ns in data.draw(st.lists(instant, min_size=1, max_size=12))
    }.values())  # fmt: skip
    for (at_ns, earliest, latest), held in zip(told, stated(truth(seen, frames_ns=[0]), told), strict=True):
        expected = {}
        for object_ix, each in seen.items():
            if (state := plain(each, at_ns)) is not None:
                expected[object_ix] = state
                continue
            there = [s for s in each if abs(at_ns - s.at_ns) <= 500 * MS]
            there = [
                s for s in there if (latest >= s.at_ns - 1_000 if s.at_ns > at_ns else earliest <= s.at_ns + 1_000)
            ]
            if there:
                nearest = min(there, key=lambda s: (abs(at_ns - s.at_ns), s.at_ns))
                state = dict(zip(VALUES, nearest.values, strict=True))
                for way, speed in (("x_m", "vx_mps"), ("y_m", "vy_mps")):
                    state[way] += state[speed] * (at_ns - nearest.at_ns) * 1e-9
                expected[object_ix] = state
        assert held.keys() == expected.keys()
        for object_ix, state in expected.items():
            same(held[object_ix], state)


@settings(deadline=None)
@given(objects(), st.lists(st.integers(-600 * MS, 9_000 * MS), max_size=12))
def test_where_no_clock_is_off_nothing_is_another_bit(seen: dict[int, list[Sighting]], at_ns: list[int]) -> None:
    world, stamps = truth(seen, frames_ns=[0]), T0_NS + np.array(sorted(at_ns), dtype=np.int64)
    asked: dict[str, Any] = {"t0_ns": T0_NS, "max_gap_s": MAX_GAP_S}
    one, other = (
        interpolate_at_instants(world, stamps, **asked),
        interpolate_at_stated_instants(world, stamps, (stamps, stamps), **asked),
    )
    for name in ("start", "object_ix", "frame_ix", "stamp_ns", *VALUES):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
