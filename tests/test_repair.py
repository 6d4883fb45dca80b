"""Velocities and heights of scenes one can compute in the head."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.repair import HEIGHTS_M, heights, velocities
from copem_replay.tracks import CLASSES

NAN = float("nan")


def along_x(time_s, x_m, vx_mps, *, start=None, moving=True):
    """Velocities along x of objects that move along x; y counts down as x counts up, to see both."""
    time_s, x_m, vx_mps = (np.array(a, dtype=float) for a in (time_s, x_m, vx_mps))
    start = np.array([0, len(x_m)] if start is None else start)
    vx, vy, notes = velocities(start, time_s, x_m, -x_m, vx_mps, -vx_mps, np.full(len(x_m), moving))
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
    vx, vy, notes = velocities(
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


@given(st.lists(st.tuples(st.floats(0.01, 0.9), st.floats(-3, 3), st.sampled_from([NAN, 0.0, 2.0, 500.0]))))
def test_velocities_against_a_plain_loop(steps):
    time_s, x_m = np.cumsum([s[0] for s in steps]), np.cumsum([s[1] for s in steps])
    logged = np.array([s[2] for s in steps])
    n = len(steps)
    cut = n // 3
    start = np.array([0, cut, n] if cut else [0, n])
    zero = np.zeros(n)
    vx, _, _ = velocities(start, time_s, x_m, zero, logged, zero, np.ones(n, dtype=bool))
    for first, last in pairwise(start):
        for k in range(first, last):
            lo = k - 1 if k > first and time_s[k] - time_s[k - 1] <= 0.5 else k
            hi = k + 1 if k + 1 < last and time_s[k + 1] - time_s[k] <= 0.5 else k
            sides = [(x_m[b] - x_m[a]) / (time_s[b] - time_s[a]) for a, b in ((lo, k), (k, hi)) if a != b]
            frozen = logged[k] == 0 and sides and min(abs(s) for s in sides) > 0.5
            wrong = not logged[k] <= 100  # NaN is not
            derived = (x_m[hi] - x_m[lo]) / (time_s[hi] - time_s[lo]) if lo != hi else 0.0
            borderline = any(abs(abs(s) - 0.5) < 1e-9 for s in sides)
            if not borderline:
                assert vx[k] == pytest.approx(derived if wrong or frozen else logged[k], abs=1e-9)


# ------------------------------------------------------------------------------- heights


def stand(rows):
    """Heights of rows (object, class, z, width, height), all moving: (z, height) per row, and notes."""
    obj, name, z, width, height = zip(*rows, strict=True)
    z, height, notes = heights(
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
    assert tuple(HEIGHTS_M) == CLASSES
    assert all(least < typical for least, typical in HEIGHTS_M.values())


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
