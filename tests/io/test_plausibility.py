"""Velocities and heights of scenes one can compute in the head."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.tracks import CLASSES
from copem_replay.io.findings import BODIES_M
from copem_replay.io.ground_truth import correct_heights, correct_velocities

NAN = float("nan")


def along_x(time_s, x_m, vx_mps, *, start=None, moving=True):
    """Velocities along x of objects that move along x; y counts down as x counts up, to see both."""
    time_s, x_m, vx_mps = (np.array(a, dtype=float) for a in (time_s, x_m, vx_mps))
    start = np.array([0, len(x_m)] if start is None else start)
    vx, vy, notes = correct_velocities(start, time_s, x_m, -x_m, vx_mps, -vx_mps, np.full(len(x_m), moving))
    assert vy.tolist() == (-vx).tolist()
    return vx.tolist(), notes


# ------------------------------------------------------------------------------- velocities


def test_velocity_not_given_is_the_central_difference():
    # 1 m, then 3 m, then 5 m in 1/4 s each: 4, 12, 20 m/s; between them the mean over half a second.
    vx, notes = along_x([0, 0.25, 0.5, 0.75], [0, 1, 4, 9], [NAN] * 4)
    assert vx == [4, 8, 16, 20]
    assert notes == ["velocity of 4 object states is not given: derived from the positions"]


def test_one_sided_beside_a_gap_and_across_tracks_nothing():
    # A gap of 0.75 s; then another object, far away.
    vx, _ = along_x([0, 0.25, 1, 1.25, 0, 0.25], [0, 1, 30, 32, 500, 503], [NAN] * 6, start=[0, 4, 6])
    assert vx == [4, 4, 8, 8, 12, 12]


def test_a_gap_of_half_a_second_is_none():
    vx, _ = along_x([0, 0.5], [0, 2], [NAN] * 2)
    assert vx == [4, 4]


def test_without_neighbours_nothing_can_be_derived():
    vx, notes = along_x([0, 1, 2], [0, 5, 10], [NAN, NAN, 3])
    assert vx == [0, 0, 3]
    assert notes == [
        "velocity of 2 object states is not given: derived from the positions",
        "velocity of 2 object states cannot be derived (no neighbour): 0 taken",
    ]


def test_zero_in_the_first_and_last_frame_of_a_moving_object_is_derived():
    vx, notes = along_x([0, 0.25, 0.5, 0.75], [0, 1, 2, 4], [0, 4, 6, 0])
    assert vx == [4, 4, 6, 8]
    assert notes == ["velocity of 2 object states is 0 though the object moves: derived from the positions"]


def test_who_is_about_to_walk_still_stands_and_who_starts_keeps_what_was_logged():
    # Stands at 0, 1/4, 1/2 s, walks 1 m/s from there on; the log says 0, 0, 0, 1, 1.
    vx, notes = along_x([0, 0.25, 0.5, 0.75, 1], [0, 0, 0, 0.25, 0.5], [0, 0, 0, 1, 1])
    assert vx == [0, 0, 0, 1, 1]
    assert notes == []
    # … or 1 m/s already at the frame where walking starts.
    assert along_x([0, 0.25, 0.5, 0.75, 1], [0, 0, 0, 0.25, 0.5], [0, 0, 1, 1, 1])[0] == [0, 0, 1, 1, 1]


def test_slow_drift_is_standing():
    # 0.4 m/s is below the 0.5 m/s that contradict a logged 0 (√2 for x and y: 0.57 is above).
    assert along_x([0, 0.25, 0.5], [0, 0.07, 0.14], [0, 0, 0])[0] == [0, 0, 0]
    assert along_x([0, 0.25, 0.5], [0, 0.125, 0.25], [0, 0, 0])[0] == [0.5, 0.5, 0.5]


def test_one_component_of_zero_is_a_velocity():
    zeros = np.zeros(3)
    vx, vy, notes = correct_velocities(
        np.array([0, 3]), np.arange(3) / 4, np.arange(3.0), zeros, zeros, np.ones(3), np.ones(3, dtype=bool)
    )
    assert vx.tolist() == [0, 0, 0]
    assert vy.tolist() == [1, 1, 1]
    assert notes == []


def test_an_impossible_speed_is_derived():
    vx, notes = along_x([0, 0.25, 0.5], [0, 10, 20], [40, 71, 40])  # √2 · 71 > 100
    assert vx == [40, 40, 40]
    assert notes == ["velocity of 1 object state exceeds 100 m/s: derived from the positions"]


def test_stationary_objects_are_left_alone():
    vx, notes = along_x([0, 0.25, 0.5], [0, 1, 2], [0, 0, 0], moving=False)
    assert vx == [0, 0, 0]
    assert notes == []


STEPS = st.lists(st.floats(0.01, 0.45), min_size=1, max_size=12)
LOGGED = st.sampled_from([NAN, 0.0, 2.0, 500.0])


@given(STEPS, st.floats(-100, 100), st.floats(-30, 30), st.floats(-5, 5))
def test_of_what_accelerates_evenly_it_is_the_speed_half_way_between_the_neighbours(steps, x0, v0, a):
    # A chord of x₀ + v₀ t + a t² / 2 is as steep as the curve half way between its ends, however long it is.
    time_s = np.cumsum([0.0, *steps])
    vx, _ = along_x(time_s, x0 + v0 * time_s + a / 2 * time_s**2, np.full(len(time_s), NAN))
    half_way_s = (np.append(time_s[1:], time_s[-1]) + np.insert(time_s[:-1], 0, time_s[0])) / 2
    assert vx == pytest.approx((v0 + a * half_way_s).tolist(), abs=1e-6)


TRACK = st.lists(st.tuples(st.floats(0.01, 0.9), st.floats(-3, 3), LOGGED), min_size=1, max_size=10)


def of_steps(steps):
    """Times, places and logged velocities."""
    time_s, x_m = np.cumsum([step[:2] for step in steps], axis=0).T
    return time_s, x_m, np.array([step[2] for step in steps])


@given(TRACK)
def test_a_velocity_that_may_be_true_is_kept_and_no_impossible_one_is(steps):
    time_s, x_m, logged = of_steps(steps)
    vx, _ = along_x(time_s, x_m, logged)
    assert [v for v, given in zip(vx, logged, strict=True) if given == 2.0] == [2.0] * int((logged == 2.0).sum())
    assert np.isfinite(vx).all()
    assert 500.0 not in vx


@given(TRACK, TRACK)
def test_tracks_have_nothing_to_do_with_each_other(one, other):
    alone = [along_x(*of_steps(steps))[0] for steps in (one, other)]
    time_s, x_m, logged = (np.concatenate(columns) for columns in zip(of_steps(one), of_steps(other), strict=True))
    together, _ = along_x(time_s, x_m, logged, start=[0, len(one), len(one) + len(other)])
    assert together == alone[0] + alone[1]


@given(TRACK)
def test_backwards_in_time_everything_moves_the_other_way(steps):
    time_s, x_m, logged = of_steps(steps)
    forwards, _ = along_x(time_s, x_m, logged)
    backwards, _ = along_x(-time_s[::-1], x_m[::-1], -logged[::-1])
    assert backwards[::-1] == pytest.approx([-v for v in forwards], abs=1e-9)


# ------------------------------------------------------------------------------- heights


def stand(rows):
    """Heights of rows (object, class, z, width, height), all moving: (z, height) per row, and notes."""
    obj, name, z, width, height = zip(*rows, strict=True)
    z, height, notes = correct_heights(
        np.array(obj),
        np.array([CLASSES.index(n) for n in name]),
        np.ones(len(rows), dtype=bool),
        np.array(z, dtype=float),
        np.array(width, dtype=float),
        np.array(height, dtype=float),
    )
    return list(zip(z.tolist(), height.tolist(), strict=True)), notes


def test_plausible_heights_are_left_alone():
    boxes, notes = stand([(0, "pedestrian", 0.9, 0.5, 1.8), (1, "car", 0.75, 1.8, 1.5), (2, "bus", 12, 2.5, 3.1)])
    assert boxes == [(0.9, 1.8), (0.75, 1.5), (12, 3.1)]
    assert notes == []


def test_an_implausible_height_becomes_the_typical_one_and_the_bottom_stays():
    # A pedestrian 0.5 m high at 10 m stands on 9.75 m: 1.75 m high, its centre is at 10.625 m.
    boxes, notes = stand([(0, "pedestrian", 10, 0.6, 0.5), (0, "pedestrian", 10, 0.6, 0.5), (1, "car", 1, 2, 0)])
    assert boxes == [(10.625, 1.75), (10.625, 1.75), (1.75, 1.5)]
    assert notes == ["height implausible or missing: 1 pedestrian (1.75 m taken), 1 car (1.5 m taken)"]


def test_no_height_is_a_box_that_stands_where_it_is():
    assert stand([(0, "car", 3, 2, 0.0)])[0] == [(3.75, 1.5)]


def test_every_class_has_a_height_that_is_plausible():
    assert tuple(BODIES_M) == CLASSES
    assert all(least < typical for _, _, typical, least in BODIES_M.values())


def test_a_flat_log_is_stood_on_the_ground():
    boxes, notes = stand([(0, "pedestrian", 0, 0.5, 1.8), (1, "car", 0, 1.8, 1.5), (2, "car", 0, 1.8, 0)])
    assert boxes == [(0.9, 1.8), (0.75, 1.5), (0.75, 1.5)]
    assert notes[0] == "every box is centred on z = 0: stood on z = 0"


def test_a_log_with_heights_is_not_flat():
    boxes, _ = stand([(0, "pedestrian", 0, 0.5, 1.8), (1, "car", -0.15, 1.8, 1.5)])
    assert boxes == [(0, 1.8), (-0.15, 1.5)]


def test_boxes_of_one_height_stand_on_one_plane_already():
    boxes, notes = stand([(0, "car", 0, 1.8, 1.5), (1, "car", 0, 1.8, 1.5)])
    assert boxes == [(0, 1.5), (0, 1.5)]
    assert notes == []


def test_height_equal_to_width_of_three_objects_is_an_exporters_defect():
    rows = [(k, "car", 1, 1.8 + k / 10, 1.8 + k / 10) for k in range(3)]
    assert stand(rows)[1] == ["the height of every moving object equals its width, a known defect of exporters"]
    assert stand(rows[:2])[1] == []
    assert stand([*rows, (3, "car", 1, 1.8, 1.5)])[1] == []


def test_a_drive_of_2_hz_has_velocities_in_every_list() -> None:
    """Lists come every 0.5 s, some a little later: with `max_gap_s` of 0.8 s there is a way to each neighbour."""
    time_s = np.array([0, 0.5, 1.02, 1.5, 2.03])
    start, nan, moving = np.array([0, 5]), np.full(5, NAN), np.full(5, True)
    vx, vy, _ = correct_velocities(start, time_s, 6 * time_s, 0 * time_s, nan, nan, moving, 0.8)
    assert vx == pytest.approx(np.full(5, 6.0))
    assert not vy.any()
    assert correct_velocities(start, time_s, 6 * time_s, 0 * time_s, nan, nan, moving)[0][4] == 0
