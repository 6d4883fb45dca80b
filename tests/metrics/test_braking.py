"""Braking when it knew, would the ego have stayed clear? Scenes for the head, and a plain oracle for random ones.

The ego is 4 m × 2 m, a pedestrian 0.5 m × 0.5 m. Where nothing else is said the ego drives along x at 10 m/s from the
origin, the driver brakes with 8 m/s² (6.25 m to a stop, 1.25 s), and the margin is 0.5 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mpmath
import numpy as np
import pandas as pd
import pytest
import scipy.optimize
import scipy.stats
import shapely
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from mpmath import mpf
from numba import njit

from copem_replay.core.errors import InputError
from copem_replay.core.geometry import box_distance, corner_travel, find_smallest_distances, pose_on_path
from copem_replay.core.tracks import Float
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.driver import (
    ConstantDeceleration,
    ConstantReaction,
    Driver,
    GammaReaction,
    LognormalReaction,
    Reaction,
)
from copem_replay.metrics.braking.encounter import Encounter, find_blocked_stretches
from copem_replay.metrics.braking.verdict import (
    fail_probability,
    find_passing_intervals,
    judge_braking,
    pass_probability,
    simulate_braking,
)
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.pipeline.run import run_experiment
from tests.helpers.drawn import examples
from tests.helpers.scenes import EGO_UNIT, SEES_ALL, Thing, driving, experiment, recording, standing
from tests.oracles.braking import Motion, corners, outcome

# As kernels call them:
box_distance, corner_travel, pose_on_path = map(
    njit,
    (box_distance, corner_travel, pose_on_path),
)

SOME = settings(
    max_examples=examples(60), suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much]
)  # an example prepares a log and judges it
BRAKES_8 = {"kind": "constant_deceleration", "a_max_mps2": 8.0}
NEVER = math.inf
COLUMNS = ["brake_s", "braking_pass", "min_distance_m", "impact_s", "impact_speed_mps", "required_deceleration_mps2"]


def plan(*, driver: dict[str, Any] | None = None, margin_m: float = 0.5, ego: str = "recorded",
         onset: dict[str, Any] | None = None, **changes: Any) -> Experiment:  # fmt: skip
    """An experiment with a driver; the truth alone is heard, from each object's first frame on."""
    standard = {
        "pems": {"sure": SEES_ALL},
        "configurations": {"GT": {"units": "truth"}},
        "measure": {"onset": onset or {"kind": "appears"}},
        "braking": {"driver": driver or BRAKES_8, "margin_m": margin_m, "ego": ego},
    }
    return experiment(**(standard | changes))


def meeting(log: Recording, wanted: Experiment) -> Encounter | None:
    """The one encounter of a log, None where it is not in conflict."""
    found = prepare_log(log, wanted).encounters
    assert len(found) <= 1
    return found[0] if found else None


def in_conflict(log: Recording, wanted: Experiment | None = None) -> Encounter:
    found = meeting(log, wanted or plan())
    assert found is not None
    return found


def rows(log: Recording, wanted: Experiment, runs: int = 1) -> pd.DataFrame:
    """The rows of `detections.parquet`."""
    return replay_block(prepare_log(log, wanted), wanted, np.arange(runs))


def straight_ego(speed_mps: float = 10.0) -> Thing:
    return Thing("ego", "car", driving(0, 0, speed_mps))


def in_the_way(range_m: float, *, until_s: float = 6.0, speed_mps: float = 10.0) -> Recording:
    """A pedestrian stands in the ego's way, at first `range_m` from its front to his near side."""
    walker = Thing("walker", "pedestrian", standing(2 + range_m + 0.25, 0))
    return recording([straight_ego(speed_mps), walker], until_s=until_s)


def crossing(*, speed_mps: float = 10.0, until_s: float = 8.0) -> Recording:
    """At x = 20 m a pedestrian crosses to the left at 1 m/s, from y = −2 m.

    He is before or behind the ego (|y| ≤ 1.25 m) from 0.75 s to 3.25 s, and less than the margin beside it from 0.25 s
    to 3.75 s. The front reaches his near side when the ego has driven 17.75 m: at 10 m/s after 1.775 s.
    """
    return recording([straight_ego(speed_mps), Thing("walker", "pedestrian", driving(20, -2, 0, 1))], until_s=until_s)


# ------------------------------------------------------------------------------------------------------------ drivers

G = 9.81
CAREFUL = ConstantDeceleration(a_max_mps2=0.774 * G, build_up_s=0.6)
"""The careful and competent driver of UN R157, by way of esmini's reading of it."""


def drives_on(driver: Driver, speed_mps: float, until_s: float = 20.0) -> tuple[Float, Float, Float]:
    """Instants, way and speed of who begins to brake at 0 s, every 10 ms."""
    encounter = in_conflict(in_the_way(speed_mps * until_s / 2, speed_mps=speed_mps, until_s=until_s))
    way, speed = simulate_braking(encounter, driver, np.array([0.0]))
    return encounter.time_s, way[0], speed[0]


@pytest.mark.parametrize(
    ("speed_mps", "a_max", "stops_after_m"), [(10, 8, 6.25), (20, 8, 25), (10, 5, 10), (1, 0.1, 5)]
)
def test_to_a_stop_takes_the_square_of_the_speed(speed_mps: float, a_max: float, stops_after_m: float) -> None:
    time_s, way, speed = drives_on(ConstantDeceleration(a_max_mps2=a_max), speed_mps)
    stops_s = speed_mps / a_max
    assert way[-1] == pytest.approx(stops_after_m)
    assert speed[-1] == 0
    half = np.interp(stops_s / 2, time_s, way), np.interp(stops_s / 2, time_s, speed)
    assert half == pytest.approx((stops_after_m * 3 / 4, speed_mps / 2), abs=1e-3), "half the time, ¾ of the way"


@pytest.mark.parametrize(
    ("speed_mps", "with_risk_m", "without_m"), [(10.0, 20.97, 16.97), (13.89, 32.73, 27.18), (16.67, 42.36, 35.69)]
)
def test_the_careful_driver_of_r157(speed_mps: float, with_risk_m: float, without_m: float) -> None:
    # Perceives the risk for 0.4 s and delays 0.75 s, at full speed; the totals are those of esmini.
    stopping = drives_on(CAREFUL, speed_mps)[1][-1]
    assert speed_mps * (0.4 + 0.75) + stopping == pytest.approx(with_risk_m, abs=5e-3)
    assert speed_mps * 0.75 + stopping == pytest.approx(without_m, abs=5e-3)


def test_the_careful_driver_within_a_scene() -> None:
    # 20.97 m at 10 m/s with all delays, 0.03 m more than that up to the margin; and then 0.03 m less.
    driver = CAREFUL.model_copy(update={"reaction": ConstantReaction(delay_s=1.15)}).model_dump()
    for range_m, clear in ((20.97 + 0.5 + 0.03, True), (20.97 + 0.5 - 0.03, False)):
        (row,) = rows(in_the_way(range_m), plan(driver=driver)).itertuples()
        assert row.brake_s == pytest.approx(1.15)
        assert row.braking_pass == clear
        assert row.min_distance_m == pytest.approx(range_m - 20.97, abs=5e-3)


@pytest.mark.parametrize(
    ("speed_mps", "stops_s", "stops_after_m"),
    [(1.0, 0.5, 1 / 3), (4.0, 1.0, 8 / 3), (5.0, 1.125, 5 - 8 / 6 + 1 / 16), (0.0625, 0.125, 0.0625 / 12)],
)
def test_stopping_while_the_deceleration_grows(speed_mps: float, stops_s: float, stops_after_m: float) -> None:
    """Jerk 8 m/s³ up to 8 m/s².

    1 m/s is gone when 4 t² = 1, after ⅔ of what it would have driven; so are 1/16 m/s, and so are 4 m/s just when the
    deceleration is reached. Of 5 m/s one is left then, after 5 − 8/6 m, and 1/16 m on it stands.
    """
    time_s, way, speed = drives_on(ConstantDeceleration(a_max_mps2=8.0, build_up_s=1.0), speed_mps)
    assert way[-1] == pytest.approx(stops_after_m, abs=1e-4)
    assert time_s[np.flatnonzero(speed == 0)[0]] == pytest.approx(stops_s, abs=0.011)


@SOME
@given(speed_mps=st.floats(0.5, 40), a_max=st.floats(2, 100), build_up_s=st.just(0.0) | st.floats(0.05, 3))
def test_braking_only_slows(speed_mps: float, a_max: float, build_up_s: float) -> None:
    _, way, speed = drives_on(ConstantDeceleration(a_max_mps2=a_max, build_up_s=build_up_s), speed_mps, 30.0)
    assert (np.diff(way) >= 0).all()
    assert (np.diff(speed) <= 0).all()
    assert speed[-1] == 0
    np.testing.assert_allclose(np.diff(way), (speed[1:] + speed[:-1]) / 2 * 0.01, atol=a_max * 0.01**2)
    # Farther than with the full deceleration at once, but by less than the way of the time it grows.
    at_once = speed_mps**2 / 2 / a_max
    rounding = a_max * 0.01**2
    assert at_once - rounding <= way[-1] <= at_once + speed_mps * build_up_s + rounding


# ---------------------------------------------------------------------------------------------------------- reactions

REACTIONS = st.one_of(
    st.builds(ConstantReaction, delay_s=st.floats(0, 10)),
    st.builds(GammaReaction, shape=st.floats(0.01, 1e4), mean_s=st.floats(0.01, 10)),
    st.builds(LognormalReaction, median_s=st.floats(0.01, 10), sigma=st.floats(0, 10)),
)


@given(reaction=REACTIONS, uniform=st.lists(st.floats(2**-53, 1 - 2**-53), min_size=1, max_size=20))
def test_delays_never_decrease(reaction: Reaction, uniform: list[float]) -> None:
    found = reaction.delays(np.sort(uniform))
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert (np.diff(found) >= -1e-12 * found[:-1]).all()


@given(shape=st.floats(0.1, 50), mean_s=st.floats(0.05, 5))
def test_gamma_delays(shape: float, mean_s: float) -> None:
    reaction = GammaReaction(shape=shape, mean_s=mean_s)
    uniform = np.array([0.001, 0.05, 0.5, 0.95, 0.999])
    law = scipy.stats.gamma(shape, scale=mean_s / shape)
    np.testing.assert_allclose(law.cdf(reaction.delays(uniform)), uniform, rtol=1e-7)


def test_means_and_medians_of_delays() -> None:
    even = (np.arange(200_000) + 0.5) / 200_000
    assert GammaReaction(shape=1.41, mean_s=0.282).delays(even).mean() == pytest.approx(0.282, rel=1e-3)
    lognormal = LognormalReaction(median_s=0.7, sigma=0.4)
    assert lognormal.delays(np.array([0.5])) == pytest.approx(0.7)
    # One standard deviation above the median of the logarithms.
    assert lognormal.delays(np.array([scipy.stats.norm.cdf(1.0)])) == pytest.approx(0.7 * math.exp(0.4))
    np.testing.assert_array_equal(ConstantReaction(delay_s=0.75).delays(even[:3]), [0.75] * 3)
    assert ConstantReaction().delays(even[:1]) == [0.0]


@pytest.mark.parametrize(
    "braking",
    [
        {},
        {"driver": {"kind": "constant_deceleration"}},
        {"driver": {"kind": "constant_deceleration", "a_max_mps2": 0}},
        {"driver": BRAKES_8 | {"build_up_s": -0.1}},
        {"driver": BRAKES_8 | {"reaction": {"kind": "constant", "delay_s": -0.1}}},
        {"driver": BRAKES_8 | {"reaction": {"kind": "gamma", "shape": 0.0, "mean_s": 1.0}}},
        {"driver": BRAKES_8 | {"reaction": {"kind": "lognormal", "median_s": 0.0, "sigma": 1.0}}},
        {"driver": BRAKES_8 | {"reaction": BRAKES_8}},
        {"driver": {"kind": "constant", "delay_s": 1.0}},
        {"driver": BRAKES_8, "margin_m": -0.1},
        {"driver": BRAKES_8, "ego": "frozen"},
    ],
)
def test_what_is_no_driver_is_refused(braking: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="braking"):
        plan(braking=braking)


def test_a_driver_is_written_with_its_defaults_and_read_again() -> None:
    wanted = plan(driver=BRAKES_8 | {"reaction": {"kind": "gamma", "shape": 1.41, "mean_s": 0.282}})
    written = wanted.as_written()
    assert written["braking"]["driver"] == {
        "kind": "constant_deceleration",
        "reaction": {"kind": "gamma", "shape": 1.41, "mean_s": 0.282},
        "a_max_mps2": 8.0,
        "build_up_s": 0.0,
    }
    assert Experiment.model_validate(written) == wanted


# -------------------------------------------------------------------------------------------------------------- boxes

Box = tuple[float, float, float, float, float]
BOX = st.tuples(
    st.floats(-30, 30), st.floats(-30, 30), st.floats(-10, 10), st.floats(0.05, 20), st.floats(0.05, 20)
)  # x, y, yaw, length, width


def in_shapely(a: Box, b: Box) -> float:
    one, two = (
        shapely.Polygon(corners(np.array([x]), np.array([y]), np.array([yaw]), length, width)[0])
        for x, y, yaw, length, width in (a, b)
    )
    return float(one.distance(two))


@settings(max_examples=examples(400))
@given(a=BOX, b=BOX)
def test_distance_of_boxes_as_in_shapely(a: Box, b: Box) -> None:
    assert box_distance(*a, *b) == pytest.approx(in_shapely(a, b), abs=1e-9)
    assert box_distance(*b, *a) == pytest.approx(box_distance(*a, *b), abs=1e-12)


@given(a=BOX, far=st.floats(-0.2, 0.2), along=st.floats(-1, 1), turned=st.floats(-4, 4), size=st.floats(0.1, 5))
def test_distance_of_boxes_at_each_others_side(a: Box, far: float, along: float, turned: float, size: float) -> None:
    # A box, turned, whose nearest corner is `far` before the front of the other: near touching is where rounding hurts.
    x, y, yaw, length, width = a
    reach = (abs(math.cos(turned)) + abs(math.sin(turned))) * size / 2
    ahead, aside = length / 2 + reach + far, along * width / 2
    b = (
        x + ahead * math.cos(yaw) - aside * math.sin(yaw),
        y + ahead * math.sin(yaw) + aside * math.cos(yaw),
        yaw + turned,
        size,
        size,
    )
    assert box_distance(*a, *b) == pytest.approx(in_shapely(a, b), abs=1e-9)


@pytest.mark.parametrize(
    ("b", "distance"),
    [
        ((0, 0, 0, 4, 2), 0),  # the same
        ((0, 0, math.pi / 2, 8, 0.5), 0),  # a plus sign: no corner of either is in the other
        ((0, 0, 0.3, 0.5, 0.5), 0),  # contained
        ((0, 0, 0.3, 50, 40), 0),  # containing
        ((1.5, 0.9, 0, 4, 2), 0),  # overlapping
        ((4, 0, 0, 4, 2), 0),  # front to rear
        ((4, 2, 0, 4, 2), 0),  # corner to corner
        ((4.3, 2.4, 0, 4, 2), 0.5),  # corner to corner, 3-4-5
        ((2 + math.sqrt(0.5) + 0.25, 0, math.pi / 4, 1, 1), 0.25),  # a corner before the front
        ((0, 3, math.pi / 2, 2, 4), 1),  # side by side
        ((10, 0, 0, 0, 0), 8),  # a point
    ],
)
def test_distances_of_boxes_by_hand(b: Box, distance: float) -> None:
    assert box_distance(0, 0, 0, 4, 2, *b) == pytest.approx(distance, abs=1e-12)
    assert box_distance(0, 0, 2 * math.pi, 4, 2, *b) == pytest.approx(distance, abs=1e-12)


# -------------------------------------------------------------------------------------------------------- worked scenes


def test_stopping_in_time_and_not() -> None:
    # 20 m ahead. Braking at 0.5 s it stops after 5 + 6.25 m. At 1.5 s 5 m are left: 10² − 2·8·5 = 20, so it hits with
    # √20 m/s, (10 − √20) / 8 s later. At 2 s the front is there; whoever brakes later has hit at 10 m/s at 2 s.
    found = judge_braking(
        in_conflict(in_the_way(20)), ConstantDeceleration(a_max_mps2=8.0), np.array([0.5, 1.5, 3.0, NEVER])
    )
    np.testing.assert_allclose(found.min_distance_m, [8.75, 0, 0, 0], atol=1e-3)
    late_s, late_mps = 1.5 + (10 - math.sqrt(20)) / 8, math.sqrt(20)
    np.testing.assert_allclose(found.impact_s, [np.nan, late_s, 2, 2], atol=2e-3)
    np.testing.assert_allclose(found.impact_speed_mps, [np.nan, late_mps, 10, 10], atol=0.02)


def test_the_object_has_left_the_way() -> None:
    # At 5 m/s the unbraked ego is there after 3.55 s, when the walker is 0.3 m beside it; seen from him it drives along
    # a line of slope 1 : 5, so its corner was nearest a moment before. With 0.5 m/s² from the start it would only stop
    # after 25 m, and gets there after (5 − √7.25) / 0.5 = 4.61 s, long after he left the margin.
    encounter = in_conflict(crossing(speed_mps=5.0))
    driver = ConstantDeceleration(a_max_mps2=0.5)
    found = judge_braking(encounter, driver, np.array([0.0, NEVER]))
    assert found.min_distance_m[0] > 0.5
    assert found.min_distance_m[1] == pytest.approx(0.3 * 5 / math.sqrt(26), abs=1e-3)
    assert np.isnan(found.impact_s).all()
    way, speed = simulate_braking(encounter, driver, np.array([0.0]))
    there_s = (5 - math.sqrt(7.25)) / 0.5
    assert np.interp(there_s, encounter.time_s, way[0]) == pytest.approx(17.75, abs=1e-3)
    assert np.interp(there_s, encounter.time_s, speed[0]) == pytest.approx(math.sqrt(7.25), abs=1e-3), "it drives on"


def test_walking_into_the_standing_ego() -> None:
    # From 10 m ahead towards the standing ego at 1.5 m/s: from 7.75 m to touch, so after 5.1667 s, whatever it does.
    walker = Thing("walker", "pedestrian", driving(10, 0, -1.5))
    log = recording([Thing("ego", "car", standing(0, 0)), walker], until_s=8.0)
    for ego in ("recorded", "constant_speed"):
        found = judge_braking(
            in_conflict(log, plan(ego=ego)), ConstantDeceleration(a_max_mps2=8.0), np.array([0.0, 3.0, NEVER])
        )
        np.testing.assert_array_equal(found.min_distance_m, 0)
        np.testing.assert_allclose(found.impact_s, 7.75 / 1.5, atol=1e-6)
        np.testing.assert_allclose(found.impact_speed_mps, 0.0, atol=1e-9)


def test_no_deceleration_helps_who_stands_in_the_way() -> None:
    walker = Thing("walker", "pedestrian", driving(10, 0, -1.5))
    encounter = in_conflict(recording([Thing("ego", "car", standing(0, 0)), walker], until_s=8.0))
    found = judge_braking(encounter, ConstantDeceleration(a_max_mps2=8.0), np.array([0.0, 3.0, NEVER]))
    np.testing.assert_array_equal(found.min_distance_m, 0)
    np.testing.assert_array_equal(found.required_mps2, [np.inf, np.inf, np.nan])


def test_too_late_for_who_walks_into_its_side() -> None:
    # Braking with 50 m/s² at 1.7 s, 0.75 m before him, it would take 1 m: it hits with √(100 − 75) m/s. Of the margin
    # 0.25 m are left: 10² / 2 · 0.25. At 1.8 s its front is past his line, and he walks into its side: nothing helps.
    found = judge_braking(in_conflict(crossing()), ConstantDeceleration(a_max_mps2=50.0), np.array([1.7, 1.8]))
    np.testing.assert_array_equal(found.min_distance_m, 0)
    np.testing.assert_allclose(found.impact_s, [1.8, 1.775], atol=2e-3)
    np.testing.assert_allclose(found.impact_speed_mps, [5, 10], atol=0.05)
    np.testing.assert_allclose(found.required_mps2, [200, np.inf], rtol=1e-3)


# --------------------------------------------------------------------------------------------- required deceleration


@pytest.mark.parametrize(("margin_m", "needed"), [(0.0, (2.5, 10 / 3, 5, 10)), (0.5, (2.564, 3.448, 5.263, 11.111))])
def test_required_deceleration_of_the_paper(margin_m: float, needed: tuple[float, ...]) -> None:
    """20 m ahead, known after 0, 0.5, 1 and 1.5 s: v² / 2 (20 − 10 l − margin)."""
    encounter = in_conflict(in_the_way(20), plan(margin_m=margin_m))
    found = judge_braking(encounter, ConstantDeceleration(a_max_mps2=8.0), np.array([0.0, 0.5, 1.0, 1.5]))
    np.testing.assert_allclose(found.required_mps2, needed, rtol=1e-3)


def test_required_deceleration_when_the_gap_is_spent() -> None:
    # 19.5 m up to the margin: at 1.95 s nothing is left.
    found = judge_braking(
        in_conflict(in_the_way(20)), ConstantDeceleration(a_max_mps2=8.0), np.array([1.94, 1.951, 2.5, NEVER])
    )
    assert found.required_mps2[0] == pytest.approx(100 / 2 / 0.1, rel=1e-3)
    np.testing.assert_array_equal(found.required_mps2[1:], [np.inf, np.inf, np.nan])


def test_required_deceleration_to_let_him_pass() -> None:
    # The walker of `crossing` is within 0.5 m before the side of the ego until 3.25 s, and beside it until 3.75 s; then
    # its front may be there: 10 · 3.75 − a/2 · 3.75² = 17.25 (2.88 m/s²), a little less as the corner rounds; and by
    # 3.25 s it has to be short of that: 10 · 3.25 − a/2 · 3.25² = 17.25.
    (found,) = judge_braking(
        in_conflict(crossing()), ConstantDeceleration(a_max_mps2=8.0), np.array([0.0])
    ).required_mps2
    assert 2 * (32.5 - 17.25) / 3.25**2 <= found <= 100 / 2 / 17.25


def test_required_deceleration_behind_a_slower_car() -> None:
    # 16 m of way to the margin behind a car at 6 m/s: 4 m/s too fast, so 4² / 2 · 16 = 0.5 m/s².
    ahead = Thing("ahead", "car", driving(4 + 16.5, 0, 6))
    log = recording([straight_ego(), ahead], until_s=20.0)
    found = judge_braking(in_conflict(log), ConstantDeceleration(a_max_mps2=8.0), np.array([0.0, 1.0, 2.0]))
    # Each second of delay takes 4 m.
    np.testing.assert_allclose(found.required_mps2, [16 / 32, 16 / 24, 16 / 16], rtol=2e-3)


@dataclass(frozen=True)
class Drive:
    """A motion along a straight line or an arc: at `at_s` it is at `place`; from `slows_s` on it decelerates."""

    speed_mps: float
    place: tuple[float, float] = (0.0, 0.0)
    at_s: float = 0.0
    heading_rad: float = 0.0
    curvature: float = 0.0  # 1 / m
    slows_s: float = math.inf
    deceleration: float = 0.0

    def way(self, t: float) -> float:
        if t <= self.slows_s or self.deceleration == 0:
            return self.speed_mps * t
        slowing = min(t - self.slows_s, self.speed_mps / self.deceleration)
        return self.speed_mps * (self.slows_s + slowing) - self.deceleration * slowing**2 / 2

    def yaw(self, t: float) -> float:
        return self.heading_rad + self.curvature * (self.way(t) - self.way(self.at_s))

    def at(self, t: float) -> tuple[float, float]:
        d, h, c = self.way(t) - self.way(self.at_s), self.heading_rad, self.curvature
        if c == 0:
            return self.place[0] + d * math.cos(h), self.place[1] + d * math.sin(h)
        return (
            self.place[0] + (math.sin(h + c * d) - math.sin(h)) / c,
            self.place[1] + (math.cos(h) - math.cos(h + c * d)) / c,
        )


There = Callable[[float], bool]


def always(t: float) -> bool:
    return True


def two(ego: Drive, other: Drive, kind: str, *, until_s: float, rate_hz: float = 10.0,
        ego_there: There = always, other_there: There = always) -> Recording:  # fmt: skip
    """A log of the ego and another, both turned as they drive."""
    things = [Thing("ego", "car", ego.at, there=ego_there), Thing("other", kind, other.at, there=other_there)]
    log = recording(things, until_s=until_s, rate_hz=rate_hz)
    yaw = np.array(
        [(ego, other)[k].yaw(t) for k, t in zip(log.truth.row_object_ix, log.truth.row_captured_s, strict=True)]
    )
    return replace(log, truth=replace(log.truth, yaw_rad=np.remainder(yaw + np.pi, 2 * np.pi)[None] - np.pi))


def motion(log: Recording, k: int) -> Motion:
    """The frames of an object of a log, as the oracle takes them."""
    truth, rows = log.truth, log.truth.row_object_ix == k
    x, y, yaw, vx, vy, length, width = (
        getattr(truth, name)[0, rows] for name in ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m")
    )
    return Motion(truth.row_captured_s[rows], x, y, yaw, np.hypot(vx, vy), float(length[0]), float(width[0]))


# -------------------------------------------------------------------------------------------------------- the oracle


@dataclass(frozen=True)
class Case:
    """A random encounter."""

    ego: Drive
    other: Drive
    kind: str
    until_s: float
    rate_hz: float
    ego_leaves_s: float
    gap_s: tuple[float, float]
    onset_s: float | None
    constant_speed: bool

    def log(self) -> Recording:
        return two(
            self.ego, self.other, self.kind, until_s=self.until_s, rate_hz=self.rate_hz,
            ego_there=lambda t: t <= self.ego_leaves_s,
            other_there=lambda t: not self.gap_s[0] < t < self.gap_s[1],
        )  # fmt: skip

    def plan(self, driver: ConstantDeceleration, margin_m: float) -> Experiment:
        return plan(
            driver=driver.model_dump(),
            margin_m=margin_m,
            onset={"kind": "appears"} if self.onset_s is None else {"kind": "at", "time_s": self.onset_s},
            ego="constant_speed" if self.constant_speed else "recorded",
        )


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """The other is near the ego's place at some instant, and there is nothing else they have in common."""
    meet_s, constant_speed = draw(st.floats(1, 4)), draw(st.booleans())
    bend = st.just(0.0) | st.floats(1 / 60, 1 / 8) | st.floats(-1 / 8, -1 / 60)
    slowing = draw(st.booleans())
    leaves_s = draw(st.just(math.inf) | st.floats(0.5, 5))
    ego = Drive(
        draw(st.just(0.0) | st.floats(3, 20)),
        heading_rad=draw(st.just(0.0) | st.floats(-4, 4)),
        curvature=draw(bend),
        slows_s=draw(st.floats(0, 4)) if slowing else math.inf,
        deceleration=draw(st.floats(1, 7)) if slowing else 0.0,
    )
    x, y = ego.at(meet_s)
    other = Drive(
        draw(st.just(0.0) | st.floats(0.5, 15)),
        (x + draw(st.floats(-4, 4)), y + draw(st.floats(-4, 4))),
        meet_s,
        ego.yaw(meet_s) + draw(st.just(0.0) | st.just(math.pi) | st.floats(-math.pi, math.pi)),
        draw(bend),
        draw(st.just(math.inf) | st.floats(0, 4)),
        draw(st.floats(1, 7)),
    )
    until_s = meet_s + draw(st.floats(0.5, 3))
    gap_from_s = draw(st.just(math.inf) | st.floats(0, meet_s))
    return Case(
        ego, other, draw(st.sampled_from(["pedestrian", "car", "truck"])), until_s,
        draw(st.sampled_from([10.0, 4.0, 25.0, 1e9 / 33_333_333])), leaves_s,
        (gap_from_s, gap_from_s + draw(st.floats(0.6, 3))),
        draw(st.none() | st.just(0.0) | st.floats(0, 0.9)), constant_speed,
    )  # fmt: skip


@st.composite
def stoppable(draw: st.DrawFn) -> Case:
    """A pedestrian who crosses once, or a car ahead that is slower or brakes: braking harder always helps."""
    meet_s, speed = draw(st.floats(1.5, 3.5)), draw(st.floats(5, 18))
    if draw(st.booleans()):
        heading = draw(st.sampled_from([-1, 1])) * draw(st.floats(math.pi / 3, 2 * math.pi / 3))
        place = speed * meet_s + draw(st.floats(-1.5, 3.5)), draw(st.floats(-2, 2))
        kind, until_s, other = "pedestrian", meet_s + 4, Drive(draw(st.floats(0.7, 3)), place, meet_s, heading)
    else:
        place, brakes_s = (4 + draw(st.floats(1, 20)), draw(st.floats(-1, 1))), draw(st.floats(0, 3))
        slower = Drive(draw(st.floats(0, speed)), place, slows_s=brakes_s, deceleration=draw(st.floats(1, 9)))
        kind, until_s, other = "car", 8.0, slower
    return Case(Drive(speed), other, kind, until_s, 10.0, math.inf, (math.inf, math.inf), None, False)


@SOME
@given(case=stoppable(), begins=st.floats(0, 1), a_max=st.floats(0.5, 12))
def test_passes_just_when_it_can_brake_harder_than_required(case: Case, begins: float, a_max: float) -> None:
    log = case.log()
    encounter = meeting(log, plan())
    assume(encounter is not None)
    assert encounter is not None
    unbraked = outcome(motion(log, 0), motion(log, 1), onset_s=0.0)
    near = np.arange(0.0, log.scene.end_s, 0.005)
    too_near_s = near[unbraked.distance(near) <= 0.5 + 0.1]
    assume(len(too_near_s) and too_near_s[0] > 0)
    brake_s = begins * too_near_s[0]
    (needed,) = judge_braking(encounter, ConstantDeceleration(a_max_mps2=8.0), np.array([brake_s])).required_mps2
    for a in (a_max, needed * 1.01, needed * 0.99):
        if 0.01 <= a <= 100 and abs(a - needed) > 0.005 * needed:
            driver = ConstantDeceleration(a_max_mps2=a)
            (least,) = judge_braking(encounter, driver, np.array([brake_s])).min_distance_m
            # Found for instants 10 ms apart; between two of them corners come nearer by (v · 5 ms)² / 2 · 0.5 m.
            if abs(least - 0.5) > 0.01:
                assert (least > 0.5) == (needed < a)


def agree(case: Case, driver: ConstantDeceleration, margin_m: float, brake_s: Float) -> bool:
    """Hold the verdicts of one encounter against the oracle; False where it is not in conflict."""
    log, wanted = case.log(), case.plan(driver, margin_m)
    ready = prepare_log(log, wanted)
    if not len(ready.episodes.object_ix):
        return False
    onset_s = float(ready.episodes.onset_s[0])
    pair = motion(log, 0), motion(log, 1)
    free = outcome(*pair, onset_s=onset_s, constant_speed=case.constant_speed)
    if abs(free.min_distance_m - margin_m) > 2e-3:
        assert bool(ready.encounters) == (free.min_distance_m <= margin_m), "in conflict"
    if not ready.encounters:
        return False
    brake_s = np.maximum(brake_s, onset_s)
    found = judge_braking(ready.encounters[0], driver, brake_s)
    for k, begin_s in enumerate(brake_s):
        expected = outcome(
            *pair, onset_s=onset_s, brake_s=float(begin_s), a_max_mps2=driver.a_max_mps2,
            build_up_s=driver.build_up_s, constant_speed=case.constant_speed,
        )  # fmt: skip
        near = found.min_distance_m[k]
        assert near == pytest.approx(expected.min_distance_m, abs=2e-3)
        if abs(expected.min_distance_m - margin_m) > 2e-3:
            assert (near > margin_m) == (expected.min_distance_m > margin_m), "passes"
        touch_s, touch_mps = found.impact_s[k], found.impact_speed_mps[k]
        assert np.isnan(touch_s) == (near > 0)
        assert np.isnan(touch_mps) == np.isnan(touch_s)
        if near > 0 or expected.touch_s is None or expected.touch_mps is None:
            continue  # at most one of the two touches, by less than 2 mm
        if abs(touch_s - expected.touch_s) > 2e-3 or abs(touch_mps - expected.touch_mps) > 0.05:
            # Only where they touch so softly that a millimetre takes longer than that.
            between = np.linspace(*sorted([touch_s, expected.touch_s]), 200)
            assert expected.distance(between).max() < 1e-3
            assert abs(touch_s - expected.touch_s) < 0.05
    return True


# It turns at 3 m/s, a little less than a decimetre from frame to frame, and leaves after an odd number of steps: its
# last frame alone says where it heads then. Metres and radians to six digits, on paper.
IN_A_BEND = Case(
    Drive(3.0, curvature=1 / 16), Drive(0.0), "truck", 5.0, 1e9 / 33_333_333, 1.5, (math.inf, math.inf), None, True
)
BESIDE_ITS_END = replace(IN_A_BEND, other=Drive(0.0, (10.532843, -0.534792), heading_rad=0.5625))
AHEAD_OF_ITS_END = replace(IN_A_BEND, other=Drive(0.0, (12.906220, 1.292978), heading_rad=0.75))
JUST_MISSED = replace(
    IN_A_BEND,
    ego=Drive(3.0, curvature=0.0576725),
    other=Drive(11.982801, (8.891452, 0.326633), 3.5, 0.614111, slows_s=1.41785, deceleration=7.0),
    kind="pedestrian",
    ego_leaves_s=1.45,
)


@pytest.mark.long
@settings(SOME, max_examples=examples(100))  # each judges a log several times
@example(case=BESIDE_ITS_END, a_max=1.0, build_up_s=0.0, margin_m=0.0, begins_s=[0.0, 0.0])
@example(case=AHEAD_OF_ITS_END, a_max=1.0, build_up_s=0.0, margin_m=0.0, begins_s=[0.0, 0.0])
@example(case=JUST_MISSED, a_max=1.0, build_up_s=0.0, margin_m=0.0, begins_s=[0.0, 0.0])
@given(
    case=cases(),
    a_max=st.floats(1, 10),
    build_up_s=st.just(0.0) | st.floats(0.2, 1),  # where it ends within a step of 10 ms, v · (10 ms)² / 8 / it is lost
    margin_m=st.sampled_from([0.0, 0.5, 2.0]),
    begins_s=st.lists(st.floats(0, 5), min_size=2, max_size=3),
)
def test_verdicts_as_the_oracle_says(
    case: Case, a_max: float, build_up_s: float, margin_m: float, begins_s: list[float]
) -> None:
    driver = ConstantDeceleration(a_max_mps2=a_max, build_up_s=build_up_s)
    agree(case, driver, margin_m, np.array([*begins_s, case.until_s + 1, NEVER]))


def test_an_ego_that_leaves_in_a_bend() -> None:
    """Its last frame, at 1.5 s, is 4.5 m along an arc of 16 m: at (4.440908, 0.628652) it heads 0.28125 rad."""
    driver, begins_s = ConstantDeceleration(a_max_mps2=1.0), np.array([0.0, NEVER])
    # With 1 m/s² from 3 m/s it stops after 4.5 m, just there; its front right corner is at (6.639882, 0.223055), in the
    # frame of the truck at (−2.888988, 2.717210), beside the 8 m × 2.5 m: 2.717210 − 1.25.
    beside = in_conflict(BESIDE_ITS_END.log(), BESIDE_ITS_END.plan(driver, 0.0))
    assert judge_braking(beside, driver, begins_s).min_distance_m[0] == pytest.approx(2.717210 - 1.25, abs=1e-4)
    # Straight on that corner starts 3.488529 m beside the truck's middle line and nears it with 1.355316 m/s.
    ahead = in_conflict(AHEAD_OF_ITS_END.log(), AHEAD_OF_ITS_END.plan(driver, 0.0))
    touch_s = 1.5 + (3.488529 - 1.25) / 1.355316
    assert judge_braking(ahead, driver, begins_s).impact_s[1] == pytest.approx(touch_s, abs=1e-4)
    # From (4.256060, 0.530455), after 4.3 m, it drives on at 0.247992 rad. The walker has stopped by 3.13 s, his centre
    # 1.335385 m to the right of that line; turned against it by 0.366119 rad he reaches 0.322930 m towards the ego.
    missed = in_conflict(JUST_MISSED.log(), JUST_MISSED.plan(driver, 0.5))
    near_m = 1.335385 - 1 - 0.322930
    assert judge_braking(missed, driver, begins_s).min_distance_m[1] == pytest.approx(near_m, abs=1e-4)
    assert meeting(JUST_MISSED.log(), JUST_MISSED.plan(driver, 0.0)) is None


@pytest.mark.parametrize("reverses", [False, True])
@pytest.mark.parametrize("frames_per_s", [30, 50, 75, 110])  # from frame to frame 10 cm, 6 cm, 4 cm, 27 mm
@pytest.mark.parametrize("ego", ["recorded", "constant_speed"])
def test_straight_on_is_as_the_last_frame_heads(ego: str, frames_per_s: int, reverses: bool) -> None:
    """It leaves at 1 s, 3 m along an arc of 8 m. The walker stands 6 m on, his near side 0.3 m beside its way."""
    drive = Drive(3.0, curvature=1 / 8)
    (x, y), yaw = drive.at(1.0), 3 / 8
    beside = 1.0 + 0.25 + 0.3
    place = (x + 6 * math.cos(yaw) + beside * math.sin(yaw), y + 6 * math.sin(yaw) - beside * math.cos(yaw))
    walker = Drive(0.0, place, heading_rad=yaw)
    log = two(drive, walker, "pedestrian", until_s=4.0, rate_hz=frames_per_s, ego_there=lambda t: t <= 1.0 + 1e-9)
    if reverses:  # the same way, its back ahead
        turned = log.truth.yaw_rad + np.where(log.truth.row_object_ix == 0, -np.pi, 0.0)
        log = replace(log, truth=replace(log.truth, yaw_rad=turned))
    encounter = in_conflict(log, plan(ego=ego, margin_m=5.0))  # at 1 s he is 3.75 m ahead
    # With 0.5 m/s² from 1 s on it stops after 9 m more, past him.
    found = judge_braking(encounter, ConstantDeceleration(a_max_mps2=0.5), np.array([1.0]))
    assert found.min_distance_m == pytest.approx(0.3, abs=1e-3)


def test_named_encounters_as_the_oracle_says() -> None:
    """One of each kind that the random ones may draw seldom; each is in conflict."""
    everywhere = Case(Drive(10), Drive(0, (25, 0)), "car", 6.0, 10.0, math.inf, (math.inf, 5.5), None, False)
    named = {
        "oncoming": replace(everywhere, other=Drive(12, (20, 1.5), 2.0, math.pi)),
        "ahead, brakes": replace(everywhere, other=Drive(10, (16, 0.5), slows_s=1.0, deceleration=6)),
        "turns into the way": replace(everywhere, other=Drive(6, (22, 0), 2.2, 0.8, -1 / 12)),
        "ego on a curve": replace(everywhere, ego=Drive(9, curvature=1 / 15), other=Drive(1.5, (14.8, 13), 2.3, 2.5)),
        "ego brakes by itself": replace(everywhere, ego=Drive(12, slows_s=0.7, deceleration=3)),
        "ego leaves first": replace(everywhere, other=Drive(1.5, (13.5, 0), 1.0, 1.6), ego_leaves_s=1.25),
        "a gap when it is hit": replace(everywhere, gap_s=(1.5, 2.65)),
        "from behind": replace(everywhere, ego=Drive(4, slows_s=1.0, deceleration=2), other=Drive(9, (-12, 0.7))),
        "between two frames": replace(everywhere, other=Drive(20, (12.5, 0), 1.25, math.pi / 2), rate_hz=2.0),
        "ego slows and leaves": replace(
            everywhere, ego=Drive(10, slows_s=1, deceleration=5), other=Drive(0, (21.6, 0)), ego_leaves_s=2.0
        ),
    }
    for name, case in named.items():
        for driver in (ConstantDeceleration(a_max_mps2=8.0), ConstantDeceleration(a_max_mps2=4.0, build_up_s=0.5)):
            begins_s = np.array([0.4, 1.1, 1.3, 2.5, NEVER])
            assert agree(case, driver, 0.5, begins_s), f"{name}: not in conflict"


@given(
    case=cases(),
    angle=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)) | st.just((691_607.0, 5_335_000.0)),
)
@settings(SOME, max_examples=30)  # each judges a log several times
def test_verdicts_do_not_depend_on_where_the_world_is(case: Case, angle: float, shift: tuple[float, float]) -> None:
    """Turned and shifted, also to where a UTM grid has Munich, all is as before."""
    log, driver = case.log(), ConstantDeceleration(a_max_mps2=6.0)
    wanted = case.plan(driver, 0.5)
    c, s, truth = math.cos(angle), math.sin(angle), log.truth
    moved = replace(
        truth,
        x_m=c * truth.x_m - s * truth.y_m + shift[0],
        y_m=s * truth.x_m + c * truth.y_m + shift[1],
        vx_mps=c * truth.vx_mps - s * truth.vy_mps,
        vy_mps=s * truth.vx_mps + c * truth.vy_mps,
        yaw_rad=np.remainder(truth.yaw_rad + angle + np.pi, 2 * np.pi) - np.pi,
    )
    here, there = meeting(log, wanted), meeting(replace(log, truth=moved), wanted)
    if here is None or there is None:
        found = [judge_braking(e, driver, np.array([NEVER])).min_distance_m[0] for e in (here, there) if e is not None]
        assert found == [] or found[0] == pytest.approx(0.5, abs=1e-5)
        return
    brake_s = np.array([0.0, 0.5, 1.0, 2.0, NEVER])
    a, b = judge_braking(here, driver, brake_s), judge_braking(there, driver, brake_s)
    np.testing.assert_allclose(a.min_distance_m, b.min_distance_m, atol=1e-5)
    touched = (a.min_distance_m == 0) & (b.min_distance_m == 0)
    if touched.any():  # where they touch softly, a rounded place may be another instant: not all of them do
        assert np.median(np.abs(a.impact_s - b.impact_s)[touched]) < 1e-4


# ------------------------------------------------------------------------------------------------ when does it pass?


def back_and_forth() -> Recording:
    """The pedestrian stands 20 m before the ego until 4 s, goes aside, and at 8 s crosses again, fast, at x = 12 m."""

    def walks(t: float) -> tuple[float, float]:
        if t <= 4:
            return 22.25, 0.0
        if t <= 6:
            return 22.25, 4.0 * (t - 4)
        return (22.25 - 10.25 * (t - 6), 8.0) if t <= 7 else (12.0, 8.0 - 8.0 * (t - 7))

    return recording([straight_ego(), Thing("walker", "pedestrian", walks)], until_s=10.0)


def test_instants_to_begin_at() -> None:
    # Braking at b the front stops at 8.25 + 10 b: short of the first place when that is below 21.5 (b < 1.325), and
    # clear of the second when the front is below 11.25 (b < 0.3), or the rear, 4 m behind, above 12.75 (b > 0.85).
    encounter, driver = in_conflict(back_and_forth()), ConstantDeceleration(a_max_mps2=8.0)
    np.testing.assert_allclose(
        find_passing_intervals(encounter, driver, 0.5), [[-np.inf, 0.3], [0.85, 1.325]], atol=1e-4
    )
    # With 4 m/s² it stops at 14.5 + 10 b: short of the first place for b < 0.7, behind the second for b > 0.225.
    np.testing.assert_allclose(
        find_passing_intervals(encounter, ConstantDeceleration(a_max_mps2=4.0), 0.5), [[0.225, 0.7]], atol=1e-4
    )
    # With 2 m/s² it needs 25 m.
    assert find_passing_intervals(encounter, ConstantDeceleration(a_max_mps2=2.0), 0.5).shape == (0, 2)


@settings(SOME, max_examples=25)  # each judges a log several times
@given(case=cases(), a_max=st.floats(2, 10), build_up_s=st.sampled_from([0.0, 0.6]), seed=st.integers(0, 2**32 - 1))
def test_passing_is_what_is_judged(case: Case, a_max: float, build_up_s: float, seed: int) -> None:
    driver = ConstantDeceleration(a_max_mps2=a_max, build_up_s=build_up_s)
    encounter = meeting(case.log(), case.plan(driver, 0.5))
    assume(encounter is not None)
    assert encounter is not None
    between_s = find_passing_intervals(encounter, driver, 0.5)
    assert (np.diff(between_s.ravel()) >= 0).all()
    last_s = encounter.time_s[-1]
    brake_s = np.append(np.random.default_rng(seed).uniform(encounter.time_s[0], last_s, 300), [last_s, NEVER])
    near = judge_braking(encounter, driver, brake_s).min_distance_m
    within = ((between_s[:, 0] <= brake_s[:, None]) & (brake_s[:, None] <= between_s[:, 1])).any(axis=1)
    wrong = brake_s[within != (near > 0.5)]
    # Two borders within 5 ms of each other are not looked for, and the border itself may fall to either side.
    borders = np.append(between_s.ravel(), -np.inf)
    off = [b for b in wrong if np.abs(b - borders).min() > 1e-6]
    assert len(off) <= 2
    assert (np.abs(near[np.isin(brake_s, off)] - 0.5) < 0.05).all()


def test_instants_to_begin_at_without_a_margin() -> None:
    # 20.012 m of way, of which stopping takes 6.25 m; to touch is no pass.
    encounter, driver = in_conflict(in_the_way(20.012), plan(margin_m=0.0)), ConstantDeceleration(a_max_mps2=8.0)
    np.testing.assert_allclose(find_passing_intervals(encounter, driver, 0.0), [[-np.inf, 1.3762]], atol=1e-4)


def test_probability_to_pass_with_one_interval() -> None:
    # `in_the_way`: with 8 m/s² it passes when it begins before 1.325 s (2 + 10 b + 6.25 = 21.5).
    between_s = find_passing_intervals(in_conflict(in_the_way(20)), ConstantDeceleration(a_max_mps2=8.0), 0.5)
    np.testing.assert_allclose(between_s, [[-np.inf, 1.325]], atol=1e-4)
    known_s = np.array([0.0, 0.3, 1.0, 1.3249, 1.33, 5.0, NEVER])
    left_s = between_s[0, 1] - known_s
    gamma = GammaReaction(shape=1.41, mean_s=0.282)
    expected = scipy.stats.gamma(1.41, scale=0.282 / 1.41).cdf(left_s)
    np.testing.assert_allclose(pass_probability(between_s, known_s, gamma), expected, atol=1e-9)
    lognormal = LognormalReaction(median_s=0.7, sigma=0.4)
    expected = scipy.stats.lognorm(0.4, scale=0.7).cdf(left_s)
    np.testing.assert_allclose(pass_probability(between_s, known_s, lognormal), expected, atol=1e-9)
    constant = ConstantReaction(delay_s=0.3)
    np.testing.assert_allclose(pass_probability(between_s, known_s, constant), [1, 1, 1, 0, 0, 0, 0], atol=1e-12)
    assert pass_probability(between_s[:0], known_s, gamma).tolist() == [0.0] * 7


DECADES = st.floats(-300, -0.01)
"""Of a probability: where on the way from 1 to 10⁻³⁰⁰."""


@settings(SOME, max_examples=examples())
@given(shape=st.floats(0.01, 500), mean_s=st.floats(0.01, 10), decades=DECADES)
def test_survival_of_gamma_to_the_far_tail(shape: float, mean_s: float, decades: float) -> None:
    """P(D > d) < e^(shape − x) (x / shape)^shape beyond the mean: some d at which it is about 10^decades."""
    beyond = scipy.optimize.brentq(lambda y: shape * (y - 1 - math.log(y)) + decades * math.log(10), 1, 1e7)
    delay_s = beyond * mean_s
    with mpmath.workdps(40):
        expected = mpmath.gammainc(shape, mpf(delay_s) * mpf(shape) / mpf(mean_s), mpmath.inf, regularized=True)
    (found,) = GammaReaction(shape=shape, mean_s=mean_s).survival(np.array([delay_s]))
    assert found == pytest.approx(float(expected), rel=1e-10, abs=1e-305)


@settings(SOME, max_examples=examples())
@given(median_s=st.floats(0.01, 10), sigma=st.floats(0.01, 10), deviations=st.floats(-5, 37))
def test_survival_of_lognormal_to_the_far_tail(median_s: float, sigma: float, deviations: float) -> None:
    delay_s = median_s * math.exp(sigma * deviations)
    with mpmath.workdps(40):
        expected = mpmath.ncdf(-mpmath.log(mpf(delay_s) / mpf(median_s)) / mpf(sigma))
    (found,) = LognormalReaction(median_s=median_s, sigma=sigma).survival(np.array([delay_s]))
    # Near the median the logarithm of a quotient that is rounded is divided by sigma, and squared in the tail.
    assert found == pytest.approx(float(expected), rel=1e-11 + 1e-14 / sigma * max(1.0, deviations), abs=0)


def test_survival_at_the_ends() -> None:
    """A constant delay, also as a log-normal one: it takes longer than anything below, and not longer than itself."""
    at_s = np.array([0.0, 0.5, 1.0, 2.0])
    for reaction in (ConstantReaction(delay_s=1.0), LognormalReaction(median_s=1.0, sigma=0.0)):
        assert reaction.survival(at_s).tolist() == [1, 1, 0, 0]
    for reaction in (GammaReaction(shape=0.01, mean_s=1.0), LognormalReaction(median_s=1.0, sigma=1.0)):
        assert reaction.survival(at_s[:1]).tolist() == [1]
    assert ConstantReaction().survival(at_s[:1]).tolist() == [0]


def test_probability_to_fail_between_and_before_what_passes() -> None:
    """It passes between 1 and 2 s and from 3 s on; of each part of the failures the smaller tail, to 40 digits."""
    between_s = np.array([[1.0, 2.0], [3.0, NEVER]])
    known_s = np.array([0.0, 0.9, 1.5, 2.2, NEVER])
    gamma = GammaReaction(shape=90.0, mean_s=1.8)  # at most 0.1 s with 10⁻⁶¹

    def within(t: float) -> Any:
        if t <= 0:
            return mpf(0)
        return mpmath.gammainc(90, 0, mpf(t) * 90 / mpf(1.8), regularized=True)

    with mpmath.workdps(200):
        expected = [
            float(within(1.0 - t) + within(3.0 - t) - within(2.0 - t)) if math.isfinite(t) else 1.0 for t in known_s
        ]
        too_soon = float(within(0.1))
    np.testing.assert_allclose(fail_probability(between_s, known_s, gamma), expected, rtol=1e-10)
    both = fail_probability(between_s, known_s, gamma) + pass_probability(between_s, known_s, gamma)
    np.testing.assert_allclose(both, 1, atol=1e-12)
    # Where only what comes too soon fails, it is the lower tail.
    assert too_soon < 1e-60
    assert fail_probability(np.array([[1.0, NEVER]]), known_s[1:2], gamma) == pytest.approx(too_soon, rel=1e-10, abs=0)
    # With nothing that passes all fails, whenever it is known.
    assert fail_probability(between_s[:0], known_s, gamma).tolist() == [1] * 5


@settings(SOME, max_examples=examples())
@given(
    reaction=st.one_of(
        st.builds(ConstantReaction, delay_s=st.floats(0, 3)),
        st.builds(GammaReaction, shape=st.floats(0.1, 100), mean_s=st.floats(0.1, 3)),
        st.builds(LognormalReaction, median_s=st.floats(0.1, 3), sigma=st.floats(0, 3)),
    ),
    borders=st.lists(st.floats(0, 9), min_size=2, max_size=6, unique=True).filter(lambda b: len(b) % 2 == 0),
    known_s=st.lists(st.floats(0, 9) | st.just(NEVER), min_size=1, max_size=5),
)
@example(reaction=ConstantReaction(delay_s=5e-324), borders=[0.0, 1.0], known_s=[NEVER])
def test_it_passes_or_fails(reaction: Reaction, borders: list[float], known_s: list[float]) -> None:
    between_s = np.sort(borders).reshape(-1, 2)
    passes = pass_probability(between_s, np.array(known_s), reaction)
    fails = fail_probability(between_s, np.array(known_s), reaction)
    assert ((passes >= 0) & (fails >= 0)).all()
    np.testing.assert_allclose(passes + fails, 1, atol=1e-12)


def test_probability_to_pass_with_two_intervals() -> None:
    """The share of drawn reactions with which the ego is judged to pass, each by itself."""
    encounter, driver = in_conflict(back_and_forth()), ConstantDeceleration(a_max_mps2=8.0)
    gamma = GammaReaction(shape=2.0, mean_s=0.6)
    known_s, draws = np.array([0.0, 0.1, 0.6, 1.0]), 4000
    delays = np.random.default_rng(11).gamma(2.0, 0.3, draws)
    near = judge_braking(encounter, driver, (known_s[:, None] + delays).ravel()).min_distance_m.reshape(4, draws)
    found = pass_probability(find_passing_intervals(encounter, driver, 0.5), known_s, gamma)
    np.testing.assert_allclose(found, (near > 0.5).mean(axis=1), atol=4 * math.sqrt(0.25 / draws))
    law = scipy.stats.gamma(2.0, scale=0.3)
    assert found[0] == pytest.approx(law.cdf(0.3) + law.cdf(1.325) - law.cdf(0.85), abs=1e-3)


@settings(SOME, max_examples=40)  # each judges a log several times
@given(
    case=cases(),
    a_max=st.floats(0.5, 12),
    build_up_s=st.just(0.0) | st.floats(0.05, 1),
    begins_s=st.tuples(st.floats(0, 4), st.floats(0, 4)),
)
def test_who_brakes_earlier_is_never_farther(
    case: Case, a_max: float, build_up_s: float, begins_s: tuple[float, float]
) -> None:
    """For an ego that keeps its speed until it brakes, however it is made to."""
    driver = ConstantDeceleration(a_max_mps2=a_max, build_up_s=build_up_s)
    case = replace(case, constant_speed=True)
    encounter = meeting(case.log(), case.plan(driver, 3.0))
    assume(encounter is not None)
    assert encounter is not None
    brake_s = np.maximum(np.array([*sorted(begins_s), NEVER]), encounter.time_s[0])
    (early, late, free), _ = simulate_braking(encounter, driver, brake_s)
    rounding = a_max * 0.01**2
    assert (early <= late + rounding).all()
    assert (late <= free + 1e-9).all()
    assert (np.diff(early) >= -1e-9).all(), "forward, or not at all"


# ------------------------------------------------------------------------------------------------------------- meaning

SEES_NOTHING = [{"detection": {"kind": "constant", "probability": 0.0}}]
HALF = [{"detection": {"kind": "constant", "probability": 0.5}}]
GAMMA = BRAKES_8 | {"reaction": {"kind": "gamma", "shape": 1.41, "mean_s": 0.282}}


def test_no_conflict_no_verdict() -> None:
    """One stands in the way, one 0.6 m beside it, one far off."""
    beside = Thing("beside", "pedestrian", standing(20, 1.85))
    far = Thing("far", "pedestrian", standing(20, 30))
    log = recording([straight_ego(), beside, Thing("in the way", "pedestrian", standing(22.25, 0)), far], until_s=6.0)
    found = rows(log, plan(measure={"onset": {"kind": "appears"}, "objects": {"classes": ["pedestrian"]}}))
    assert found["object_id"].tolist() == ["beside", "in the way", "far"]
    assert found["conflict"].tolist() == [False, True, False]
    assert found["conflict"].dtype == bool
    assert found.loc[[0, 2], COLUMNS].isna().all(axis=None)
    row = found.iloc[1]
    assert (row["brake_s"], row["braking_pass"], row["detection_s"]) == (0.0, True, 0.0)
    assert row["min_distance_m"] == pytest.approx(20 - 6.25, abs=1e-3)
    assert row["required_deceleration_mps2"] == pytest.approx(100 / 2 / 19.5, rel=1e-3)
    assert row[["impact_s", "impact_speed_mps"]].isna().all()
    # Half a metre beside it is within the margin of 0.5 m; and what is there to see does not depend on the driver.
    nearer = replace(log, truth=replace(log.truth, y_m=np.where(log.truth.y_m == 1.85, 1.75, log.truth.y_m)))
    assert rows(nearer, plan())["conflict"].tolist() == [True, True, False]
    without = rows(log, plan(braking=None))
    pd.testing.assert_frame_equal(found[without.columns], without)
    assert not {"conflict", *COLUMNS} & {*without.columns}


@pytest.mark.parametrize("margin_m", [0.5, 0.0])
def test_never_detected_does_not_brake_and_is_judged(margin_m: float) -> None:
    """Without a margin, too: what is hit is exactly 0 m away, and not passed."""
    wanted = plan(
        driver=GAMMA,
        margin_m=margin_m,
        pems={"sure": SEES_NOTHING},
        configurations={"GT": {"units": "truth"}, "blind": {"units": ["ego"]}},
    )
    found = rows(in_the_way(20), wanted).set_index("configuration")
    assert found.loc["GT", "braking_pass"]
    blind = found.loc["blind"]
    assert blind["conflict"]
    assert not blind["detected"]
    assert not blind["braking_pass"]
    assert blind[["brake_s", "required_deceleration_mps2"]].isna().all()
    assert blind["min_distance_m"] == 0.0
    assert blind["impact_s"] == pytest.approx(2.0)
    assert blind["impact_speed_mps"] == pytest.approx(10.0)


def test_never_detected_and_only_near() -> None:
    # 0.3 m beside the ego: within the margin, and no impact.
    beside = Thing("beside", "pedestrian", standing(20, 1.55))
    wanted = plan(pems={"sure": SEES_NOTHING}, configurations={"blind": {"units": ["ego"]}})
    (row,) = rows(recording([straight_ego(), beside], until_s=6.0), wanted).itertuples()
    assert row.conflict
    assert not row.braking_pass
    assert row.min_distance_m == pytest.approx(0.3)
    assert math.isnan(row.impact_s)
    assert math.isnan(row.impact_speed_mps)


def test_what_is_known_before_the_onset_is_reacted_to_from_the_onset_on() -> None:
    driver = BRAKES_8 | {"reaction": {"kind": "constant", "delay_s": 0.25}}
    measure = {"onset": {"kind": "at", "time_s": 0.55}, "count_earlier": True}
    (early,) = rows(in_the_way(20), plan(driver=driver, measure=measure)).itertuples()
    assert early.detection_s == 0.0
    assert early.time_to_detection_s == pytest.approx(-0.55)
    assert early.brake_s == pytest.approx(0.8)
    # Not counted earlier, it is known from the next list on, at 0.6 s.
    (row,) = rows(in_the_way(20), plan(driver=driver, measure=measure | {"count_earlier": False})).itertuples()
    assert row.detection_s == pytest.approx(0.6)
    assert row.brake_s == pytest.approx(0.85)


def test_what_was_before_the_onset_is_no_conflict() -> None:
    # `crossing`, from when the ego at 10 m/s has hit him (1.775 s) and passed; and from just before.
    assert meeting(crossing(), plan(onset={"kind": "at", "time_s": 1.7})) is not None
    assert meeting(crossing(), plan(onset={"kind": "at", "time_s": 2.9})) is None


def test_an_ego_that_was_recorded_braking() -> None:
    """It brakes from 1 s on with 5 m/s² and stands after 20 m, 5 m before him; else it would have hit him at 2.5 s."""
    walker = Thing("walker", "pedestrian", standing(2 + 25 + 0.25, 0))
    log = recording([Thing("ego", "car", Drive(10, slows_s=1.0, deceleration=5.0).at), walker], until_s=6.0)
    (recorded,) = rows(log, plan()).itertuples()
    assert not recorded.conflict
    constant = plan(
        ego="constant_speed",
        pems={"sure": SEES_NOTHING},
        configurations={"GT": {"units": "truth"}, "blind": {"units": ["ego"]}},
    )
    known, blind = rows(log, constant).itertuples()
    assert known.conflict
    assert blind.conflict
    assert known.braking_pass
    assert known.min_distance_m == pytest.approx(25 - 6.25, abs=1e-3)
    assert blind.impact_s == pytest.approx(2.5)
    assert blind.impact_speed_mps == pytest.approx(10.0)
    # From an onset while it brakes: at 2 s, after 17.5 m, it has 5 m/s and 7.5 m to go, and hits 1.5 s later.
    later = plan(ego="constant_speed", onset={"kind": "at", "time_s": 2.0})
    found = judge_braking(in_conflict(log, later), ConstantDeceleration(a_max_mps2=8.0), np.array([NEVER]))
    assert found.impact_s[0] == pytest.approx(3.5, abs=5e-3)
    assert found.impact_speed_mps[0] == pytest.approx(5.0, abs=0.01)


def test_the_declared_driver_never_gets_farther_than_was_driven() -> None:
    # Recorded, the ego brakes with 5 m/s² from 1 s on and stands 0.2 m before him; the driver brakes with 2 from 0.5 s.
    walker = Thing("walker", "pedestrian", standing(2 + 20.2 + 0.25, 0))
    log = recording([Thing("ego", "car", Drive(10, slows_s=1.0, deceleration=5.0).at), walker], until_s=6.0)
    encounter = in_conflict(log)
    (weak,), _ = simulate_braking(encounter, ConstantDeceleration(a_max_mps2=2.0), np.array([0.5]))
    # At 1 s it is 0.25 m behind with 9 m/s, and 1/6 m more when after 1/3 s both have 8⅓ m/s; from there as recorded.
    np.testing.assert_allclose(weak[-1], 20 - 1 / 4 - 1 / 6, atol=0.01)
    assert (weak <= encounter.course.along_m + 1e-9).all()


def test_nor_where_its_speedometer_exaggerates() -> None:
    # Velocities a tenth above what the places say: from 1 s on, hardly braking, it would be 1 m ahead after 1 s.
    log = in_the_way(20)
    exaggerating = replace(log, truth=replace(log.truth, vx_mps=log.truth.vx_mps * 1.1))
    encounter = in_conflict(exaggerating)
    (way,), _ = simulate_braking(encounter, ConstantDeceleration(a_max_mps2=0.01), np.array([1.0]))
    assert (way <= encounter.course.along_m + 1e-9).all()


def test_one_reaction_for_all_configurations_and_in_any_batch() -> None:
    wanted = plan(
        driver=GAMMA,
        runs=40,
        pems={"sure": HALF},
        units={"ego": EGO_UNIT, "mast": {"at": [5, 5], "height_m": 4.0, "pem": "sure"}},
        configurations={
            "GT": {"units": "truth"},
            "PEM": {"units": ["ego"]},
            "late": {"units": "all", "latency_s": 0.35},
        },
    )
    ready = prepare_log(in_the_way(30), wanted)
    batch = replay_block(ready, wanted, np.arange(40))
    delay_s = (batch["brake_s"] - batch["detection_s"]).to_numpy().reshape(3, 40)
    np.testing.assert_allclose(delay_s[1:], delay_s[[0, 0]], atol=1e-9)
    assert len(np.unique(np.round(delay_s[0], 9))) == 40, "another one in every run"
    for number in (0, 17):
        alone = replay_block(ready, wanted, np.array([number]))
        pd.testing.assert_frame_equal(alone, batch[batch["run"] == number].reset_index(drop=True))
    # Another configuration, another unit, another object: the delays are what they were.
    fewer = plan(driver=GAMMA, runs=40)
    found = rows(in_the_way(30), fewer, 40)
    np.testing.assert_allclose(found["brake_s"] - found["detection_s"], delay_s[0], atol=1e-9)
    other = rows(in_the_way(30), plan(driver=GAMMA, seed=8), 40)
    assert not np.isclose(other["brake_s"] - other["detection_s"], delay_s[0]).any(), "the seed is in the address"
    law = scipy.stats.gamma(1.41, scale=0.2)
    assert scipy.stats.kstest(delay_s[0], law.cdf).pvalue > 1e-3


def test_every_row_is_judged_by_its_own_instant() -> None:
    """The table says what `judge` says, run by run."""
    wanted = plan(driver=GAMMA, runs=30, pems={"sure": HALF}, configurations={"PEM": {"units": ["ego"]}})
    log = in_the_way(12)
    found = rows(log, wanted, 30)
    assert 0 < found["braking_pass"].sum() < 30
    for row in found.itertuples():
        one = judge_braking(in_conflict(log, wanted), wanted.braking.driver, np.array([row.brake_s]))  # type: ignore[union-attr]
        assert row.min_distance_m == one.min_distance_m[0]
        assert row.braking_pass == (one.min_distance_m[0] > 0.5)
        np.testing.assert_array_equal(row.impact_s, one.impact_s[0])
        assert row.required_deceleration_mps2 == one.required_mps2[0]


def test_two_at_once_are_judged_each_by_itself() -> None:
    """The nearer one is in the way of the ego that brakes for the farther one, and yet no business of his."""
    near, far = (Thing(name, "pedestrian", standing(x, 0)) for name, x in (("near", 12.25), ("far", 42.25)))
    both = rows(recording([straight_ego(), far, near], until_s=8.0), plan())
    for row, thing in zip(both.itertuples(), (far, near), strict=True):
        (alone,) = rows(recording([straight_ego(), thing], until_s=8.0), plan()).itertuples()
        assert row.object_id == alone.object_id
        assert row.min_distance_m == alone.min_distance_m
        assert row.required_deceleration_mps2 == alone.required_deceleration_mps2


# ------------------------------------------------------------------------------------------------ models of one's own


class Coasts(Driver):
    """Loses a share of its speed every second: v · e^(−k·t), and so v · (1 − e^(−k·t)) / k metres."""

    per_s: float

    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        result: Float = self.per_s * speed_mps * np.exp(-elapsed_s * self.per_s)
        return result


class Attentive(Reaction):
    """Every second driver looks: 0.2 s, the others 0.6 s."""

    def delays(self, uniform: Float) -> Float:
        return np.where(uniform < 0.5, 0.2, 0.6)


class Crashes(Driver):
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        return elapsed_s.no_such_thing  # type: ignore[attr-defined, no-any-return]


class Flat(Driver):
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        return elapsed_s[0]


class Speeds(Driver):
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        return elapsed_s - 1.0


class Forgets(Driver):
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        return elapsed_s * np.nan


class Wall(Driver):
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        return np.full(elapsed_s.shape, np.inf)


class Text(Driver):
    def deceleration_mps2(self, elapsed_s: Float, speed_mps: Float) -> Float:
        return np.full(elapsed_s.shape, "hard")  # type: ignore[return-value]


class Lacks(Driver):
    """Lacks its method."""


class Early(Reaction):
    def delays(self, uniform: Float) -> Float:
        return uniform - 1.0


class Endless(Reaction):
    def delays(self, uniform: Float) -> Float:
        return np.full(len(uniform), np.inf)


class Unsure(Reaction):
    def delays(self, uniform: Float) -> Float:
        return np.full(len(uniform), np.nan)


class One(Reaction):
    def delays(self, uniform: Float) -> Float:
        return np.array([0.5])


class Wrong(Attentive):
    """Says how probably it takes at most so long, not longer."""

    def survival(self, delay_s: Float) -> Float:
        return np.where(delay_s < 0.2, 0.0, np.where(delay_s < 0.6, 0.5, 1.0))


class Sooner(Attentive):
    """A survival function of another reaction: 0.5 s at most."""

    def survival(self, delay_s: Float) -> Float:
        return np.where(delay_s < 0.2, 1.0, np.where(delay_s < 0.5, 0.5, 0.0))


class Percents(Attentive):
    def survival(self, delay_s: Float) -> Float:
        return np.where(delay_s < 0.6, 50.0, 0.0)


class Single(Attentive):
    def survival(self, delay_s: Float) -> Float:
        return np.array([0.5])


class Stumbles(Attentive):
    def survival(self, delay_s: Float) -> Float:
        raise RuntimeError("two\nlines")


class Right(Attentive):
    def survival(self, delay_s: Float) -> Float:
        return np.where(delay_s < 0.2, 1.0, np.where(delay_s < 0.6, 0.5, 0.0))


class Breaks(Reaction):
    def delays(self, uniform: Float) -> Float:
        raise RuntimeError("two\nlines")


def test_a_driver_and_a_reaction_of_ones_own() -> None:
    own = {
        "kind": "tests.metrics.test_braking:Coasts",
        "per_s": 2.0,
        "reaction": {"kind": "tests.metrics.test_braking:Attentive"},
    }
    found = rows(in_the_way(20), plan(driver=own), runs=30)
    assert {*np.round(found["brake_s"], 9)} == {0.2, 0.6}
    # It comes to rest 10 / 2 m after it began, but for 10 / 2 · e^(−2 · 5.4) m and the millimetre of steps of 10 ms.
    early = found[found["brake_s"] < 0.4].iloc[0]
    assert early["min_distance_m"] == pytest.approx(20 - 2 - 5, abs=2e-3)
    between_s = find_passing_intervals(in_conflict(in_the_way(20), plan(driver=own)), Coasts(kind="x", per_s=2.0), 0.5)
    assert pass_probability(between_s, np.array([1.0]), Attentive(kind="x")) == pytest.approx(0.5)


def test_a_reaction_of_ones_own_with_a_driver_of_ours() -> None:
    found = rows(
        in_the_way(20), plan(driver=BRAKES_8 | {"reaction": {"kind": "tests.metrics.test_braking:Attentive"}}), runs=30
    )
    assert {*np.round(found["brake_s"], 9)} == {0.2, 0.6}


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("Crashes", r"AttributeError: .*no_such_thing.*test_braking\.py:\d+"),
        ("Flat", r"deceleration_mps2\(elapsed_s, speed_mps\): expected shape \(1, \d+\), found \(\d+,\)"),
        ("Speeds", r"deceleration_mps2\(elapsed_s, speed_mps\): expected m/s² ≥ 0, found -"),
        ("Forgets", r"deceleration_mps2\(elapsed_s, speed_mps\): expected m/s² ≥ 0, found nan"),
        ("Wall", r"deceleration_mps2\(elapsed_s, speed_mps\): expected m/s² ≥ 0, found inf"),
        ("Text", r"ValueError: .*'hard'"),
    ],
)
def test_a_driver_that_fails_is_named(kind: str, said: str) -> None:
    with pytest.raises(InputError, match=rf"^braking\.driver: tests.metrics.test_braking:{kind}: .*{said}") as failure:
        rows(in_the_way(20), plan(driver={"kind": f"tests.metrics.test_braking:{kind}"}))
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("Early", r"delays\(uniform\): expected seconds ≥ 0, found -"),
        ("Endless", r"delays\(uniform\): expected seconds ≥ 0, found inf"),
        ("Unsure", r"delays\(uniform\): expected seconds ≥ 0, found nan"),
        ("One", r"delays\(uniform\): expected shape \(3,\), found \(1,\)"),
        ("Breaks", r"RuntimeError: two lines \(.*test_braking\.py:\d+\)"),
    ],
)
def test_a_reaction_that_fails_is_named(kind: str, said: str) -> None:
    driver = BRAKES_8 | {"reaction": {"kind": f"tests.metrics.test_braking:{kind}"}}
    with pytest.raises(
        InputError, match=rf"^braking\.driver\.reaction: tests.metrics.test_braking:{kind}: {said}"
    ) as failure:
        rows(in_the_way(20), plan(driver=driver), runs=3)
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("Wrong", r"survival\(delay_s\): expected at 0\.6 s, which is delays\(0\.5\), at most 0\.5; found 1"),
        ("Sooner", r"survival\(delay_s\): expected at 0\.6 s, which is delays\(0\.5\), at least 0\.5; found 0"),
        ("Percents", r"survival\(delay_s\): expected probabilities 0 … 1, found 50\.0"),
        ("Single", r"survival\(delay_s\): expected shape \(2,\), found \(1,\)"),
        ("Stumbles", r"RuntimeError: two lines \(.*test_braking\.py:\d+\)"),
    ],
)
def test_a_survival_that_is_not_of_the_delays_is_named(kind: str, said: str) -> None:
    own = {"kind": f"tests.metrics.test_braking:{kind}"}
    reaction = plan(driver=BRAKES_8 | {"reaction": own}).braking.driver.reaction  # type: ignore[union-attr]
    with pytest.raises(
        InputError, match=rf"^braking\.driver\.reaction: tests.metrics.test_braking:{kind}: {said}"
    ) as failure:
        fail_probability(np.array([[-NEVER, 0.3]]), np.array([0.0, 0.1]), reaction)
    assert "\n" not in str(failure.value)


def test_a_survival_of_ones_own() -> None:
    """Every second one is too late where 0.3 s are left, all where 0.1 s are, none where 0.7 s are."""
    between_s, known_s = np.array([[-NEVER, 1.0]]), np.array([0.7, 0.9, 0.3])
    for kind, early in ((Right, 0.0), (Attentive, math.nan)):
        found = fail_probability(between_s, known_s, kind(kind="x"))
        np.testing.assert_allclose(found, [0.5, 1.0, early], rtol=1e-12)


def test_a_driver_without_its_method_is_refused() -> None:
    with pytest.raises(ValueError, match=r"tests.metrics.test_braking:Lacks' lacks deceleration_mps2"):
        plan(driver={"kind": "tests.metrics.test_braking:Lacks"})


# --------------------------------------------------------------------------------------------------------- at the edges


def test_an_object_that_is_back_for_its_last_frame_only() -> None:
    # 28 m ahead, gone from 1 s on and back at 3 s for one frame. Braking at 0.5 s, the ego stands 16.5 m before him.
    there: Callable[[float], bool] = lambda t: t < 1.01 or t > 2.99  # noqa: E731
    log = recording([straight_ego(), Thing("walker", "pedestrian", standing(30, 0), there=there)], until_s=3.0)
    found = judge_braking(in_conflict(log), ConstantDeceleration(a_max_mps2=8.0), np.array([0.5]))
    assert found.min_distance_m[0] == pytest.approx(30 - 0.25 - 2 - 11.25, abs=1e-3)
    assert np.isnan(found.impact_s[0])


def test_an_ego_whose_last_frame_is_a_few_nanoseconds_before_a_node() -> None:
    # Frames of a camera with 30 Hz, 33 333 333 ns apart: the last one of the ego at 0.99999999 s. He is 1 m away then.
    log = recording(
        [
            Thing("ego", "car", driving(0, 0, 10), there=lambda t: t < 1.01),
            Thing("walker", "pedestrian", standing(13.25, 0)),
        ],
        until_s=2.0,
        rate_hz=1e9 / 33_333_333,
    )
    assert meeting(log, plan()) is None


def test_an_object_of_one_frame_that_is_touched() -> None:
    there: Callable[[float], bool] = lambda t: abs(t - 1) < 0.01  # noqa: E731
    log = recording([straight_ego(), Thing("walker", "pedestrian", standing(11, 0), there=there)], until_s=2.0)
    (row,) = rows(log, plan()).itertuples()
    assert row.impact_s == pytest.approx(1.0)
    assert row.impact_speed_mps == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("there", "touch_s", "x_m"),
    [(lambda t: t < 1.01, 1.0, 12.25), (lambda t: t < 1.01 or t > 1.99, 2.0, 20.0)],
    ids=["at the ego's last frame", "when the ego is back after a gap"],
)
def test_who_is_hit_is_hit_with_some_speed(there: Callable[[float], bool], touch_s: float, x_m: float) -> None:
    ego = Thing("ego", "car", driving(0, 0, 10), there=there)
    log = recording([ego, Thing("walker", "pedestrian", standing(x_m, 0))], until_s=3.0)
    found = judge_braking(in_conflict(log), ConstantDeceleration(a_max_mps2=8.0), np.array([NEVER]))
    assert found.impact_s[0] == pytest.approx(touch_s)
    assert found.impact_speed_mps[0] == pytest.approx(10.0)


def test_no_deceleration_helps_who_was_hit_before() -> None:
    # `crossing` is hit at 1.775 s, and out of the way at 4 s.
    found = judge_braking(in_conflict(crossing()), ConstantDeceleration(a_max_mps2=8.0), np.array([4.0]))
    assert found.min_distance_m[0] == 0
    assert found.required_mps2[0] == np.inf


def test_required_deceleration_for_who_overtakes() -> None:
    """A cyclist comes from behind in the ego's lane, overtakes it 2.2 m to the left and cuts in at 3 s, slower.

    At 0.5 s he is behind the ego, yet ahead of where it was at the onset.
    """

    def rides(t: float) -> tuple[float, float]:
        x = -8 + 14 * min(t, 3.2) + 5 * max(t - 3.2, 0)
        return x, min(2.2, 3 * max(t - 0.3, 0)) if t < 3 else max(2.2 - 3 * (t - 3), 0)

    log = recording([straight_ego(), Thing("bicycle", "bicycle", rides, size_m=(1.8, 0.6, 1.8))], until_s=7.0)
    encounter = in_conflict(log)
    (needed,) = judge_braking(encounter, ConstantDeceleration(a_max_mps2=8.0), np.array([0.5])).required_mps2
    assert 0.01 < needed < 8
    for a_max, passes in ((needed * 1.01, True), (needed * 0.99, False)):
        found = judge_braking(encounter, ConstantDeceleration(a_max_mps2=a_max), np.array([0.5]))
        assert (found.min_distance_m[0] > 0.5) == passes


def test_required_deceleration_when_the_ego_comes_back() -> None:
    """The ego drives 15 m ahead, stands from 5 s to 6 s, and reverses with 2 m/s, over who has stepped behind it.

    Its rear reaches him after 6.75 m, and the margin after 6.25 m, of which 2 m are driven at 7 s: 2² / 2 · 4.25.
    """

    def turns(t: float) -> tuple[float, float]:
        return 3 * min(t, 5) - 2 * max(t - 6, 0), 0.0

    walker = Thing("walker", "pedestrian", lambda t: (6.0, max(6 - 1.2 * t, 0.0)))
    encounter = in_conflict(recording([Thing("ego", "car", turns), walker], until_s=12.0))
    found = judge_braking(encounter, ConstantDeceleration(a_max_mps2=8.0), np.array([7.0, NEVER]))
    assert found.min_distance_m[0] > 0.5
    assert found.impact_s[1] == pytest.approx(6 + 6.75 / 2)
    assert found.required_mps2[0] == pytest.approx(4 / 2 / 4.25, rel=1e-2)


def test_required_deceleration_for_who_comes_back() -> None:
    """`back_and_forth` from 0 s on: it has to stand before his first place, after 19.5 m: 10² / 2 · 19.5 = 2.564.

    That is the smallest, not a bound: with 4 m/s² its body stands where he crosses at 8 s, with 6 m/s² before that.
    """
    encounter, begin_s = in_conflict(back_and_forth()), np.array([0.0])
    for a_max, passes in ((2.55, False), (2.6, True), (2.9, True), (4.0, False), (6.0, True)):
        found = judge_braking(encounter, ConstantDeceleration(a_max_mps2=a_max), begin_s)
        assert (found.min_distance_m[0] > 0.5) == passes, a_max
        assert found.required_mps2[0] == pytest.approx(100 / 2 / 19.5, rel=1e-2)


def test_stretches_that_a_post_beside_the_way_blocks() -> None:
    """A car of 4 m × 2 m drives along x; a post of 1 m × 1 m, turned by 30°, stands beside its way."""
    path, size, post = np.array([[0.0, 0, 0, 0], [60.0, 60, 0, 0]]), np.array([4.0, 2.0]), np.array([1.0, 1.0])
    for y, blocks in ((1.9, True), (-2.0, True), (2.8, False)):
        other, stretch_m = np.array([[20.0], [y], [np.pi / 6]]), np.empty((2, 2, 1))
        find_blocked_stretches(path, size, other, post, 0.5, 0.0, np.array([60.0]), stretch_m)
        tried_m = np.arange(14.0, 26.0, 1e-3)
        left_m = [in_shapely((s, 0.0, 0.0, 4.0, 2.0), (20.0, y, np.pi / 6, 1.0, 1.0)) - 0.5 for s in tried_m]
        within_m = tried_m[np.array(left_m) <= 0]
        assert bool(len(within_m)) == blocks
        if blocks:
            assert stretch_m[0, :, 0] == pytest.approx([within_m[0], within_m[-1]], abs=2e-3)
        assert np.isinf(stretch_m[int(blocks) :]).all()


def test_probability_to_pass_without_delay_at_the_onset() -> None:
    encounter, driver = in_conflict(in_the_way(20)), ConstantDeceleration(a_max_mps2=8.0)
    between_s = find_passing_intervals(encounter, driver, 0.5)
    assert judge_braking(encounter, driver, np.array([0.0])).min_distance_m[0] > 0.5
    assert pass_probability(between_s, np.array([0.0]), ConstantReaction()).tolist() == [1.0]


def test_constant_speed_beyond_a_stop_with_a_millimetre_of_noise() -> None:
    """Recorded, the ego stops 4 m before him and stands there for 2.5 s, known to a millimetre."""
    walker = Thing("walker", "pedestrian", standing(2 + 16.5 + 0.25, 0))
    log = recording([Thing("ego", "car", Drive(10, slows_s=0.0, deceleration=4.0).at), walker], until_s=5.0)
    truth = log.truth
    stands = (truth.row_object_ix == 0) & (truth.row_captured_s > 2.55)
    noise = np.random.default_rng(1).normal(0, 1e-3, (2, len(stands))) * stands
    noisy = replace(log, truth=replace(truth, x_m=truth.x_m + noise[0], y_m=truth.y_m + noise[1]))
    assert meeting(log, plan(ego="constant_speed")) is not None
    assert meeting(noisy, plan(ego="constant_speed")) is not None


def test_the_ego_does_not_jump_when_it_leaves() -> None:
    # Recorded it brakes from 1 s on with 8 m/s², stands from 2.25 s on at 16.25 m and leaves; the driver begins at
    # 0.5 s with 2 m/s², for which 5 + 10 · 1.8 − 1.8² = 19.76 m would be too far.
    ego = Thing("ego", "car", Drive(10, slows_s=1.0, deceleration=8.0).at, there=lambda t: t < 2.31)
    log = recording([ego, Thing("walker", "pedestrian", standing(16.25 + 2.25 + 0.4, 0))], until_s=5.0)
    encounter = in_conflict(log)
    (way,), _ = simulate_braking(encounter, ConstantDeceleration(a_max_mps2=2.0), np.array([0.5]))
    assert np.diff(way).max() <= 10.0 * 0.01 + 1e-6
    # Behind by 0.25 m at 1 s, and by 1/12 m more when both have 8⅔ m/s.
    assert way[-1] == pytest.approx(16.25 - 1 / 4 - 1 / 12, abs=0.02)


def test_who_brakes_earlier_is_never_farther_where_the_ego_slowed_down() -> None:
    """Recorded: 10 m/s, from 1 s to 2 s down to 2 m/s, from 2 s to 4 s up to 10 m/s again; the driver brakes with 2."""

    def drives(t: float) -> tuple[float, float]:
        if t < 2:
            return Drive(10, slows_s=1.0, deceleration=8.0).at(t)
        return 16 + 2 * (t - 2) + 2 * min(t - 2, 2) ** 2 + 8 * max(t - 4, 0), 0.0

    log = recording([Thing("ego", "car", drives), Thing("walker", "pedestrian", standing(45, 0))], until_s=9.0)
    encounter = in_conflict(log)
    (early, late), _ = simulate_braking(encounter, ConstantDeceleration(a_max_mps2=2.0), np.array([1.0, 2.0]))
    assert late[-1] == pytest.approx(17.0, abs=0.05), "from 16 m at 2 m/s"
    assert early[-1] <= late[-1] + 1e-6


@pytest.mark.parametrize(("back_m", "meets"), [(0.0, False), (0.25, False), (1.9, False), (2.1, True)])
def test_noise_of_a_place_is_no_reversing(back_m: float, meets: bool) -> None:
    """It stops after 12.5 m; its last place is a little back. At constant speed from the onset on, 10 m/s, it goes on
    ahead, not back into the one who stands 15 m behind it; only who goes back by 2 m is in reverse."""

    def stops(t: float) -> tuple[float, float]:
        return Drive(10, slows_s=0.0, deceleration=4.0).at(t)[0] - (back_m if t > 3.95 else 0.0), 0.0

    things = [Thing("ego", "car", stops), Thing("behind", "pedestrian", standing(-15, 0))]
    log = recording(things, until_s=6.0)
    wanted = plan(ego="constant_speed", measure={"onset": {"kind": "appears"}})
    assert (meeting(log, wanted) is not None) == meets


def test_two_in_conflict_have_no_interval_and_it_is_said() -> None:
    """Two stand in the way, one behind the other: too few objects, and their runs are no other traffic."""
    things = [straight_ego(), *(Thing(name, "pedestrian", standing(x, 0)) for name, x in (("a", 20), ("b", 25)))]
    result = run_experiment(plan(runs=3), [recording(things, until_s=4.0)])
    assert result.summary["pass_interval"].isna().all()
    assert any("no interval of the pass share: 2 objects of one drive, fewer than 5; " in n for n in result.notes)


# ------------------------------------------------------------------------------------------------ at the boundaries


def test_an_impact_is_no_pass_though_the_margin_is_0() -> None:
    # 6.25 m to a stop: 5 m are not enough, and the boxes touch, at a distance of 0.
    for range_m, passes, distance_m in ((5.0, False, 0.0), (6.5, True, 0.25)):
        (row,) = rows(in_the_way(range_m), plan(margin_m=0.0)).itertuples()
        assert (row.braking_pass, row.min_distance_m) == (passes, pytest.approx(distance_m, abs=5e-3))


def test_beyond_its_ends_a_path_goes_straight_on() -> None:
    path = np.array([[0.0, 0, 0, 0.2], [10.0, 10, 0, 0.7]])  # arc length, x, y, yaw
    assert pose_on_path(path, 5.0) == pytest.approx((5, 0, 0.45))
    assert pose_on_path(path, 20.0) == pytest.approx((20, 0, 0.7)), "turned no further"
    assert pose_on_path(path, -10.0) == pytest.approx((-10, 0, 0.2))


def test_how_far_a_corner_moves_while_the_ego_turns() -> None:
    # 4 m × 3 m: a corner is 2.5 m from the middle, half a radian on the second metre moves it by 1.25 m more.
    path = np.array([[0.0, 0, 0, 0], [1.0, 1, 0, 0], [2.0, 2, 0, -0.5]])
    assert corner_travel(path, np.array([4.0, 3.0])) == pytest.approx(2.25)
    assert corner_travel(path[:2], np.array([4.0, 3.0])) == 1.0


def test_who_passes_between_two_instants_and_turns_away_is_as_near_as_it_passed() -> None:
    """2 m boxes; the other goes by 3 m off within one step, and is farther off at each instant."""
    path, box = np.array([[0.0, 0, 0, 0], [1e-6, 1e-6, 0, 0]]), np.array([2.0, 2.0])
    near, touch = np.empty(1), np.empty(1)
    other = np.array([[-5.0, 15.0, -15.0], [3.0, 3.0, 20.0], [0.0, 0.0, 0.0]])  # x, y, yaw
    find_smallest_distances(np.zeros((1, 3)), path, box, other, box, near, touch)
    assert (near[0], touch[0]) == (pytest.approx(1.0), np.inf)


@pytest.mark.parametrize("who", ["ego", "other"])
def test_a_bar_that_turns_on_the_spot_hits_what_it_sweeps_over(who: str) -> None:
    """10 m × 1 m, by half a turn: before and after 2.5 m from a box that its end reaches half way."""
    instants = np.linspace(0.0, 1.0, 5)
    bar, box, still = np.array([10.0, 1.0]), np.array([2.0, 2.0]), np.zeros(5)
    near, touch = np.empty(1), np.empty(1)
    if who == "ego":
        path = np.array([[0.0, 0, 0, 0], [1e-6, 1e-6, 0, math.pi]])
        find_smallest_distances(
            (instants * 1e-6)[None], path, bar, np.stack([still, still + 4.0, still]), box, near, touch
        )
    else:
        path = np.array([[0.0, 0, 4, 0], [1e-6, 1e-6, 4, 0]])
        find_smallest_distances(still[None], path, box, np.stack([still, still, instants * math.pi]), bar, near, touch)
    assert near[0] == 0
    # A long side, half a metre from the middle, meets the box's lower corner at (±1, 3), √10 m away, where the corner's
    # bearing from the bar is asin(0.5 / √10): at atan2(3, 1) less that.
    assert touch[0] / 4 * math.pi == pytest.approx(math.atan2(3, 1) - math.asin(0.5 / math.sqrt(10)), abs=1e-3)
