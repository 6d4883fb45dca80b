"""How far off lists are: every figure in a scene one can compute in the head, and all sums against plain loops."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from copem_replay.core.object_list import Entries, ObjectLists
from copem_replay.core.tracks import CLASSES
from copem_replay.metrics.accuracy.aggregator import Aggregator
from copem_replay.metrics.accuracy.kernel import expect_gated_nees
from copem_replay.metrics.accuracy.metrics import ACCURACY
from copem_replay.metrics.accuracy.statistics import (
    Accuracy,
    AccuracySettings,
    AccuracyTotal,
    join_totals,
    repeat_for_runs,
    sum_accuracy,
)
from copem_replay.metrics.gospa import gospa, ospa
from copem_replay.metrics.matching import Matches, match_at_both_times, match_entries
from copem_replay.metrics.summary_metrics import METRIC
from tests.helpers.at_once import assess
from tests.helpers.drawn import examples
from tests.helpers.reports import between, chunks, entry, lists_of
from tests.helpers.reports import joined as one_list
from tests.oracles.accuracy import (
    Places,
    episodes_of,
    expected_of,
    matches_of,
    one_run,
    permuted,
    plainly,
    reference_of,
    scene_of,
    taken,
    truth_of,
)
from tests.oracles.origin import unknown_origins

expect_gated_nees = njit(expect_gated_nees)  # as kernels call it

EGO, CAR, OTHER_CAR = 0, 1, 2
NOTHING = one_list()
GATE_M = 3.0


def classes(*names: str) -> Any:
    return np.isin(CLASSES, names)


def assessed(
    *runs: Sequence[Entries], places: Places, episodes: dict[int, tuple[float, float]],
    times_s: Sequence[float] | None = None, of: Sequence[str] = ("car", "car", "car", "car"), since_s: float = 0.0,
    velocity: dict[int, tuple[float, float]] | None = None, captures: tuple[Sequence[float], Places] | None = None,
    ego: Sequence[tuple[float, float] | None] | None = None, measured: Sequence[str] = ("car",), **given: Any,
) -> Accuracy:  # fmt: skip
    """Lists at 0, 1, 2 … s around an ego at the origin, that tell of now or of `captures`; cut-off 3 m."""
    K = len(runs[0])
    times = np.array(range(K) if times_s is None else times_s, dtype=float)
    at_ego = [(0.0, 0.0)] * K if ego is None else list(ego)
    truth = {EGO: at_ego, **places}
    world, scene, lists = truth_of(truth, times.tolist(), velocity), scene_of(*of), lists_of(runs)
    about = now = match_entries(lists, world, scene, unknown_origins(lists), gate_m=GATE_M)
    if captures is not None:
        about, now = match_at_both_times(
            lists, truth_of(captures[1], captures[0]), world, scene, unknown_origins(lists), gate_m=GATE_M
        )
    settings = AccuracySettings(**({"cutoff_m": 3.0, "gate_m": GATE_M} | given))
    return assess(
        lists, about, now, times, world, scene, episodes_of(episodes), np.full(len(episodes), since_s),
        reference_of(at_ego), classes(*measured), settings=settings,
    )  # fmt: skip


FIGURES = {metric.name: metric for metric in ACCURACY}


def figure(name: str, of: Accuracy) -> float | None:
    return FIGURES[name].value(sum_accuracy([of]))


def standing(x_m: float, y_m: float, count: int) -> list[tuple[float, float]]:
    return [(x_m, y_m)] * count


def test_position_error_and_bias_of_pairs() -> None:
    lists = [entry(11, 0), NOTHING, entry(10, 2)]
    of = assessed(lists, places={CAR: standing(10, 0, 3)}, episodes={CAR: (0, 2)})
    assert of.error_m.tolist() == [[1.0, pytest.approx(math.nan, nan_ok=True), 2.0]]
    assert figure("position_rmse_m", of) == pytest.approx(math.sqrt(5 / 2))
    assert figure("bias_east_m", of) == pytest.approx(0.5)
    assert figure("bias_north_m", of) == pytest.approx(1.0)
    sums = of.by_object[0, 0]
    assert (sums["looked"], sums["missed"], sums["pairs"]) == (3, 1, 2)


def test_latency_is_an_error_now_and_none_at_capture() -> None:
    # The car drives at 2 m/s; each list shows it where it was half a second ago.
    times = [1.0, 2.0, 3.0]
    lists = [entry(2 * (t - 0.5), 20, captured_s=t - 0.5, vx_mps=2.0) for t in times]
    captures = [0.5, 1.5, 2.5]
    of = assessed(
        lists, times_s=times, places={CAR: [(2 * t, 20) for t in times]}, velocity={CAR: (2, 0)},
        episodes={CAR: (0, 3)}, captures=(captures, {CAR: [(2 * t, 20) for t in captures]}),
    )  # fmt: skip
    assert figure("position_rmse_m", of) == pytest.approx(1.0)
    assert figure("bias_east_m", of) == pytest.approx(-1.0)
    assert figure("position_rmse_captured_m", of) == pytest.approx(0.0)
    assert figure("age_of_information_s", of) == pytest.approx(0.5)
    assert figure("velocity_rmse_mps", of) == pytest.approx(0.0)


def test_what_tells_of_an_instant_without_truth_is_about_nobody() -> None:
    lists = [entry(10.5, captured_s=t) for t in (0.0, 0.5, 2.0 + 9e-7, 2.5)]
    captures = ([0.0, 0.5, 2.0, 2.5], {CAR: [(10.0, 0.0), None, (11.5, 0.0), None]})
    of = assessed(lists, places={CAR: standing(10, 0, 4)}, episodes={CAR: (0, 3)}, captures=captures)
    assert of.by_object[0, 0]["pairs"] == 2
    assert figure("position_rmse_captured_m", of) == pytest.approx(math.sqrt((0.5**2 + 1.0**2) / 2))
    # Now the car is there: its entries are no ghosts, and none of it is missed.
    assert (of.by_run[0]["ghosts"], of.by_object[0, 0]["missed"]) == (0, 0)
    assert of.by_existence["with_object"].sum() == 2
    gone = assessed(lists, places={CAR: standing(10, 0, 4)}, episodes={CAR: (0, 3)}, captures=([0.0], {}))
    assert figure("position_rmse_captured_m", gone) is None


def late_by(latency_s: float, speed_mps: float = 12.0, count: int = 5) -> Accuracy:
    """A car at some speed, each list of it late; a second one stands somewhere else."""
    times = np.arange(1.0, 1.0 + count)
    captures = times - latency_s
    ways = {t: [(speed_mps * t, 20.0) for t in each] for t, each in (("now", times), ("then", captures))}
    lists = [
        entry(speed_mps * c, 20.5, captured_s=c, vx_mps=speed_mps, existence=0.8, track_id=k // 3)
        for k, c in enumerate(captures.tolist())
    ]
    return assessed(
        lists, times_s=times.tolist(), places={CAR: ways["now"]}, velocity={CAR: (speed_mps, 0)},
        episodes={CAR: (0, count)}, captures=(captures.tolist(), {CAR: ways["then"]}),
    )  # fmt: skip


@pytest.mark.parametrize("latency_s", [0.1, 0.5, 2.0])
def test_latency_counts_in_full_whatever_the_gate(latency_s: float) -> None:
    of = late_by(latency_s)
    assert of.by_object[0, 0]["pairs"] == of.by_object[0, 0]["placed"] == 5
    assert figure("position_rmse_m", of) == pytest.approx(math.hypot(12 * latency_s, 0.5))
    assert figure("bias_east_m", of) == pytest.approx(-12 * latency_s)
    assert figure("velocity_rmse_mps", of) == pytest.approx(0.0)
    assert figure("age_of_information_s", of) == pytest.approx(latency_s)
    assert figure("identity_switches", of) == 1.0
    # At the instants the entries tell of.
    assert figure("position_rmse_captured_m", of) == pytest.approx(0.5)
    assert figure("nees", of) == pytest.approx(0.25)
    assert figure("existence_ece", of) == pytest.approx(0.2)


@pytest.mark.parametrize(("latency_s", "stale_per_min"), [(0.1, 0.0), (0.5, 75.0)])  # 5 in 4 s
def test_what_a_stale_list_is_worth_now(latency_s: float, stale_per_min: float) -> None:
    of, none = late_by(latency_s), stale_per_min == 0
    assert figure("stale_false_positives_per_min", of) == pytest.approx(stale_per_min)
    assert figure("false_positives_per_min", of) == 0.0, "they are about somebody"
    assert of.by_object[0, 0]["missed"] == (0 if none else 5)
    assert figure("longest_gap_s", of) == pytest.approx(1.0 if none else 5.0)
    assert figure("gospa_missed_m", of) == pytest.approx(0.0 if none else math.sqrt(4.5))


def test_what_is_about_nobody_now_and_then_is_a_ghost_and_what_was_about_somebody_is_stale() -> None:
    lists = [one_list(entry(10, captured_s=0.0, existence=0.9), entry(50, captured_s=0.0, existence=0.6))] * 2
    captures = ([0.0], {CAR: [(10.0, 0.0)]})
    of = assessed(
        lists, times_s=[1, 2], places={CAR: standing(20, 0, 2)}, episodes={CAR: (1, 2)}, captures=captures,
        existence_thresholds=(0.0, 0.7),
    )  # fmt: skip
    assert (of.by_run[0]["ghosts"], of.by_run[0]["stale_ghosts"]) == (2, 2)
    assert of.ghosts_at.tolist() == [[2, 0]]
    assert of.by_existence["with_object"][0].tolist() == [0] * 9 + [2]


def test_a_pair_whose_object_has_a_gap_now_has_no_error_now() -> None:
    lists = [entry(10.5, captured_s=0.0, track_id=3)] * 3
    captures = ([0.0], {CAR: [(10.0, 0.0)]})
    of = assessed(
        lists, places={CAR: [(10, 0), None, (12, 0)]}, episodes={CAR: (0, 2)}, captures=captures,
        distance_edges_m=(0.0, 60.0), time_edges_s=(1.0, 2.0),
    )  # fmt: skip
    sums = of.by_object[0, 0]
    assert (sums["pairs"], sums["placed"], sums["tracked"], sums["looked"]) == (3, 2, 3, 2)
    np.testing.assert_array_equal(of.error_m, [[0.5, np.nan, 1.5]])
    assert figure("position_rmse_m", of) == pytest.approx(math.sqrt((0.25 + 2.25) / 2))
    assert figure("bias_east_m", of) == pytest.approx(-0.5)
    assert figure("velocity_rmse_mps", of) == 0.0
    assert figure("nees", of) == pytest.approx(0.25)
    assert figure("age_of_information_s", of) == pytest.approx(1.0)
    assert (of.by_distance[0, 0]["pairs"], of.by_time[0, 0]["pairs"], of.by_time[0, 0]["placed"]) == (2, 1, 0)
    # Nor can a list hold or miss what is not there.
    assert sums["missed"] == 0


@pytest.mark.parametrize(
    ("large", "small", "beyond", "expected"),
    [
        (1.0, 0.1, 0.00286, 1.9717),
        (4.0, 0.25, 0.1394, 1.5263),
        (4.0, 0.01, 0.1338, 1.5506),
        (1.0, 1.0, math.exp(-4.5), (2 - 11 * math.exp(-4.5)) / (1 - math.exp(-4.5))),
        (4.0, 4.0, 0.3247, 0.9184),
        (0.1, 0.05, 0.0, 2.0),
    ],
)
def test_what_the_gate_cuts_off(large: float, small: float, beyond: float, expected: float) -> None:
    # Turned by 30°.
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    cov = (large * c * c + small * s * s, (large - small) * c * s, large * s * s + small * c * c)
    of = assessed([entry(10, cov=cov)] * 2, places={CAR: standing(10, 0, 2)}, episodes={CAR: (0, 1)})
    assert figure("beyond_gate_share", of) == pytest.approx(beyond, abs=5e-5)
    assert figure("nees_expected", of) == pytest.approx(expected, abs=5e-5)


def test_the_gate_cuts_the_mean_and_the_spread_of_true_covariances() -> None:
    """Errors drawn with the covariance claimed: RMSE 1.92 instead of 2.83 m at v = 4, and NEES where its band says."""
    rng, variance, count = np.random.default_rng(5), 4.0, 4000
    runs = [[entry(10 + x, y, cov=(variance, 0, variance))] for x, y in rng.normal(0, math.sqrt(variance), (count, 2))]
    of = assessed(*runs, places={CAR: [(10, 0)]}, episodes={CAR: (0, 0)})
    assert figure("position_rmse_m", of) == pytest.approx(1.92, abs=0.02)
    nees = of.by_object["nees"][of.by_object["pairs"] > 0]
    assert len(nees) / count == pytest.approx(1 - 0.3247, abs=0.02)
    low, mean, high = (figure(name, of) for name in ("nees_low", "nees_expected", "nees_high"))
    assert low is not None
    assert high is not None
    assert low < nees.mean() < high
    assert mean == pytest.approx(0.9184, abs=1e-4)
    # As wide as the mean of as many such samples is uncertain.
    assert (high - low) / 2 / 1.96 == pytest.approx(nees.std() / math.sqrt(len(nees)), rel=0.03)


@settings(max_examples=examples(60))  # each integrates over a plane by quadrature
@given(st.floats(-9, 4), st.floats(0, 4), st.sampled_from([0.3, 3.0, 50.0]))
@example(4.0, 0.5, 0.3)  # next to nothing is within
def test_what_is_expected_within_the_gate_as_integrals_have_it(large: float, less: float, gate_m: float) -> None:
    one, two = 10.0**large, 10.0 ** max(large - less, -9.0)
    found = expect_gated_nees(one, two, gate_m)
    wanted = expected_of(entry(0, cov=(one, 0.0, two))[0], gate_m)
    np.testing.assert_allclose(found, wanted, rtol=5e-5, atol=2e-9)


def test_velocity_error_is_the_length_of_the_difference() -> None:
    lists = [entry(10, vx_mps=8.0, vy_mps=4.0), entry(10, vx_mps=5.0, vy_mps=0.0)]
    of = assessed(lists, places={CAR: standing(10, 0, 2)}, velocity={CAR: (5, 0)}, episodes={CAR: (0, 1)})
    assert figure("velocity_rmse_mps", of) == pytest.approx(math.sqrt(25 / 2))


def test_pairs_count_before_the_onset_but_nothing_is_looked_at_then() -> None:
    lists = [entry(11), entry(11), entry(11), NOTHING]
    of = assessed(lists, places={CAR: standing(10, 0, 4)}, episodes={CAR: (2, 3)}, since_s=1.0)
    sums = of.by_object[0, 0]
    assert (of.first_list.tolist(), of.count.tolist()) == ([1], [3])
    assert (sums["pairs"], sums["looked"], sums["missed"]) == (2, 2, 1)
    np.testing.assert_array_equal(of.error_m, [[1, 1, np.nan]])
    np.testing.assert_array_equal(of.gospa, [[np.nan, 1, 4.5]])


def test_nothing_counts_while_there_is_no_ego_nor_while_the_object_is_missing_nor_after_the_end() -> None:
    lists = [entry(11)] * 5
    ego = [(0.0, 0.0), None, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)]
    of = assessed(lists, places={CAR: [(10, 0), (10, 0), None, (10, 0), (10, 0)]}, episodes={CAR: (0, 3)}, ego=ego)
    np.testing.assert_array_equal(of.error_m, [[1, np.nan, np.nan, 1]])
    assert of.by_object[0, 0]["looked"] == 2
    assert of.by_run[0]["lists"] == 4
    assert of.by_run[0]["ghosts"] == 1  # where the car is missing from the truth


@pytest.mark.parametrize(
    ("cov", "error", "expected"),
    [
        ((4.0, 0.0, 1.0), (2.0, 1.0), 2.0),
        ((2.0, 1.0, 2.0), (1.0, 1.0), 2 / 3),  # eigenvalue 3 along the error
        ((2.0, 1.0, 2.0), (1.0, -1.0), 2.0),  # eigenvalue 1
        ((0.0, 0.0, 0.0), (3e-5, 0.0), 0.9),  # variances of 1e-9 at least
        ((1.0, 1.0, 1.0), (1.0, 1.0), 1.0),  # singular: 2 along the diagonal
    ],
)
def test_nees(cov: tuple[float, float, float], error: tuple[float, float], expected: float) -> None:
    of = assessed([entry(10 + error[0], error[1], cov=cov)], places={CAR: [(10, 0)]}, episodes={CAR: (0, 0)})
    assert figure("nees", of) == pytest.approx(expected, rel=1e-6)


def test_nees_band_is_of_as_many_samples_as_rows_with_a_match() -> None:
    def of_rows(n: int) -> Accuracy:
        matched, missed = [entry(10), entry(10)], [NOTHING, NOTHING]
        return assessed(*[matched] * n, missed, places={CAR: standing(10, 0, 2)}, episodes={CAR: (0, 1)}, gate_m=100.0)

    hundred, more = of_rows(100), of_rows(500)
    band = [figure("nees_low", hundred), figure("nees_high", hundred)]
    assert band == pytest.approx([1.627, 2.411], abs=5e-4)
    assert [figure("nees_low", more), figure("nees_high", more)] == pytest.approx([1.829, 2.179], abs=5e-4)


def test_identity_switches_are_changes_of_the_track_last_named() -> None:
    tracks = [5, 5, -1, 7, 7, 5]
    lists = [entry(10, track_id=track) for track in tracks]
    none = [entry(10)] * 6
    of = assessed(lists, none, [NOTHING] * 6, places={CAR: standing(10, 0, 6)}, episodes={CAR: (0, 5)})
    assert of.by_object["switches"].tolist() == [[2], [0], [0]]
    assert of.by_object["tracked"].tolist() == [[5], [0], [0]]
    assert figure("identity_switches", of) == pytest.approx(2.0)  # of the one run that names tracks
    assert figure("identity_switches", assessed(none, places={CAR: standing(10, 0, 6)}, episodes={CAR: (0, 5)})) is None


def test_duplicates_of_measured_objects() -> None:
    both = one_list(entry(10, existence=0.9), entry(10.1, existence=0.8), entry(40), entry(40.1))
    places = {CAR: standing(10, 0, 4), OTHER_CAR: standing(40, 0, 4)}  # the other one is not measured
    of = assessed([both] * 4, places=places, episodes={CAR: (2, 3)})
    assert of.by_object[0, 0]["duplicates"] == 2  # in the lists looked at
    assert of.by_run[0]["duplicates"] == 4  # in all
    assert figure("duplicates_per_min", of) == pytest.approx(80.0)  # 4 in 3 s
    assert figure("false_positives_per_min", of) == 0.0


@pytest.mark.parametrize(
    ("held", "episode", "longest_s"),
    [
        ("11111", (0, 4), 0.0),
        ("00000", (0, 4), 4.0),
        ("00110", (0, 4), 2.0),
        ("10001", (0, 4), 3.0),  # unknown from the list at 1 s to the one at 4 s
        ("10000", (0, 4.5), 3.5),
        ("10000", (0.5, 4), 3.0),  # known before the onset, till the list at 1 s
        ("01000", (0.5, 4), 2.0),
        ("00001", (1.5, 4), 2.5),
        ("10001", (1.5, 4), 2.5),  # known and lost again before the onset
        ("1.101", (0, 4), 1.0),  # a list that says nothing about it changes nothing
        ("1.001", (0, 4), 2.0),
    ],
)
def test_longest_time_unknown(held: str, episode: tuple[float, float], longest_s: float) -> None:
    lists = [entry(10) if h == "1" else NOTHING for h in held]
    ego = [None if h == "." else (0.0, 0.0) for h in held]
    of = assessed(lists, places={CAR: standing(10, 0, 5)}, episodes={CAR: episode}, ego=ego)
    assert of.by_object[0, 0]["longest_gap_s"] == pytest.approx(longest_s)
    assert figure("longest_gap_s", of) == pytest.approx(longest_s)


def test_before_the_first_list_it_is_unknown() -> None:
    of = assessed([entry(10)] * 2, times_s=[2.0, 3.0], places={CAR: standing(10, 0, 2)}, episodes={CAR: (0.5, 3)})
    assert of.by_object[0, 0]["longest_gap_s"] == pytest.approx(1.5)
    # Nor is a list from before its stay one of them.
    of = assessed([entry(10), NOTHING], places={CAR: standing(10, 0, 2)}, episodes={CAR: (1, 1.5)}, since_s=1.0)
    assert of.by_object[0, 0]["longest_gap_s"] == pytest.approx(0.5)


def test_never_matched() -> None:
    of = assessed([NOTHING] * 3, places={CAR: standing(10, 0, 3)}, episodes={CAR: (0, 2)})
    for name in ("position_rmse_m", "position_rmse_captured_m", "bias_east_m", "velocity_rmse_mps",
                 "age_of_information_s", "nees",
                 "nees_low", "nees_high", "identity_switches", "existence_ece"):  # fmt: skip
        assert figure(name, of) is None, name
    assert figure("longest_gap_s", of) == pytest.approx(2.0)
    assert figure("gospa_m", of) == figure("gospa_missed_m", of) == pytest.approx(math.sqrt(9 / 2))
    assert figure("ospa_m", of) == pytest.approx(3.0)
    assert of.by_object[0, 0]["missed"] == of.by_object[0, 0]["looked"] == 3


def test_ghosts_are_of_measured_classes_and_of_no_object_at_all() -> None:
    entries = one_list(
        entry(0.2), entry(30, 1), entry(10), entry(60), entry(12, 8, existence=0.4), entry(70, of="pedestrian")
    )
    places = {CAR: standing(10, 0, 3), OTHER_CAR: standing(20, 0, 3), 3: standing(30, 0, 3)}
    of = assessed(
        [entries, NOTHING, entries], places=places, episodes={CAR: (0, 2), OTHER_CAR: (1, 2)},
        existence_thresholds=(0.0, 0.4, 0.5, 1.0),
    )  # fmt: skip
    # At the ego and at a neighbour nobody measures: no ghosts. The one at 60 m and the one beside the car are.
    assert of.by_run[0]["ghosts"] == 4
    assert of.ghosts_at.tolist() == [[4, 4, 2, 2]]
    assert of.by_object["ghosts"].tolist() == [[3, 1]]  # at 0 s the other car is not yet looked at
    assert figure("false_positives_per_min", of) == pytest.approx(120.0)  # 4 in 3 lists at 1 Hz: 2 s


def test_a_ghost_halfway_goes_to_the_first() -> None:
    places = {OTHER_CAR: [(30.0, 0.0)], CAR: [(20.0, 0.0)]}
    of = assessed([entry(25)], places=places, episodes={CAR: (0, 0), OTHER_CAR: (0, 0)})
    assert of.by_object["ghosts"].tolist() == [[1, 0]]
    assert of.gospa.tolist() == [[9.0, 4.5]]


def test_where_nothing_is_looked_at_there_is_neither_gospa_nor_ospa_and_ghosts_are_nobodys() -> None:
    of = assessed([entry(50)] * 2, places={CAR: standing(10, 0, 2)}, episodes={CAR: (1, 1)})
    assert (of.by_run[0]["lists"], of.by_run[0]["lists_looked"]) == (2, 1)
    assert of.by_run[0]["ghosts"] == 2
    assert of.by_object["ghosts"].tolist() == [[1]]
    assert of.by_object[0, 0]["gospa_false"] == pytest.approx(4.5)
    # Of the list at 1 s alone: one object missed, one false entry.
    assert figure("gospa_false_m", of) == pytest.approx(math.sqrt(4.5))
    assert figure("gospa_missed_m", of) == pytest.approx(math.sqrt(4.5))
    assert figure("gospa_m", of) == pytest.approx(3.0)
    assert figure("ospa_m", of) == pytest.approx(3.0)
    # An object that is missing from the truth is not looked at then.
    gone = assessed([entry(50)] * 3, places={CAR: [(10, 0), None, (10, 0)]}, episodes={CAR: (0, 2)})
    assert gone.by_run[0]["lists_looked"] == 2
    assert figure("gospa_m", gone) == pytest.approx(3.0)


def test_gospa_and_ospa_of_the_worked_example() -> None:
    # Truth at 0, 10 and 20 m, believed 1 m beside, 0.5 m ahead, and at 40 m.
    shown = one_list(entry(0, 1), entry(10.5), entry(40))
    places = {1: [(0, 0)], 2: [(10, 0)], 3: [(20, 0)]}
    of = assessed([shown], places=places, episodes=dict.fromkeys(places, (0, 0)), ego=[(-50, 0)], cutoff_m=5.0)
    assert figure("gospa_m", of) == pytest.approx(5.123475, abs=1e-6)
    assert figure("ospa_m", of) == pytest.approx(2.958040, abs=1e-6)
    assert figure("gospa_localisation_m", of) == pytest.approx(math.sqrt(1.25))
    assert figure("gospa_missed_m", of) == figure("gospa_false_m", of) == pytest.approx(math.sqrt(12.5))
    assert of.gospa.tolist() == [[1.0, 0.25, 25.0]]
    first_power = assessed(
        [shown], places=places, episodes=dict.fromkeys(places, (0, 0)), ego=[(-50, 0)], cutoff_m=5.0, power=1.0
    )
    assert first_power.gospa.tolist() == [[1.0, 0.5, 5.0]]
    assert figure("gospa_m", first_power) == pytest.approx(6.5)
    assert figure("ospa_m", first_power) == pytest.approx(6.5 / 3)


def test_gospa_takes_the_best_pairs_though_the_match_is_another() -> None:
    lists = [one_list(entry(10, existence=0.5), entry(11, existence=0.9))]
    of = assessed(lists, places={CAR: [(10, 0)]}, episodes={CAR: (0, 0)})
    assert of.error_m.tolist() == [[1.0]]
    assert of.gospa.tolist() == [[4.5]]  # no distance, one false entry


def test_gospa_leaves_out_what_is_at_objects_not_looked_at() -> None:
    entries = one_list(entry(0.1), entry(10), entry(20), entry(20.5), entry(30))
    places = {CAR: standing(10, 0, 2), OTHER_CAR: standing(20, 0, 2), 3: standing(30, 0, 2)}
    of = assessed([entries] * 2, places=places, episodes={CAR: (0, 1), OTHER_CAR: (1, 1)})
    np.testing.assert_array_equal(of.gospa, [[0, 0, np.nan, 4.5]])
    assert figure("gospa_m", of) == figure("gospa_false_m", of) == pytest.approx(math.sqrt(4.5 / 2))
    assert figure("ospa_m", of) == pytest.approx((0 + math.sqrt(9 / 3)) / 2)  # at 1 s two objects and three entries


def test_an_unclassified_entry_at_what_is_looked_at_is_believed_but_no_ghost() -> None:
    entries = one_list(entry(10, of="other"), entry(50, of="other"))
    of = assessed([entries], places={CAR: [(10, 0)]}, episodes={CAR: (0, 0)})
    assert of.gospa.tolist() == [[0.0]]
    assert of.by_run[0]["ghosts"] == 0
    assert of.by_existence["entries"].sum() == 0


def test_expected_calibration_error() -> None:
    # Of four entries at 0.85 three are of the car, of two at 0.25 none; ten bins of equal width.
    high, low = [entry(10, existence=0.85)] * 3 + [entry(50, existence=0.85)], [entry(60, existence=0.25)] * 2
    of = assessed([*high, *low], places={CAR: standing(10, 0, 6)}, episodes={CAR: (0, 5)})
    assert figure("existence_ece", of) == pytest.approx((4 * 0.10 + 2 * 0.25) / 6)
    assert of.by_existence["entries"].tolist() == [[0, 0, 2, 0, 0, 0, 0, 0, 4, 0]]
    assert of.by_existence["with_object"][0, 8] == 3
    ends = assessed([entry(10, existence=1.0), entry(10, existence=0.0)], places={CAR: standing(10, 0, 2)}, episodes={})
    assert ends.by_existence["entries"].tolist() == [[1, 0, 0, 0, 0, 0, 0, 0, 0, 1]]
    assert figure("existence_ece", ends) == pytest.approx(0.5)


def test_claims_that_are_too_high_do_not_make_up_for_those_that_are_too_low() -> None:
    # Two entries at 0.25 are of the car, two at 0.75 of nothing: off by 0.75 each way.
    of = assessed(
        [entry(10, existence=0.25)] * 2 + [entry(50, existence=0.75)] * 2,
        places={CAR: standing(10, 0, 4)}, episodes={CAR: (0, 3)},
    )  # fmt: skip
    assert figure("existence_ece", of) == pytest.approx(0.75)


def test_bands_of_distance_and_time() -> None:
    # The car is 10, 20, 30 and 40 m away; the list at 2 s misses it, one ghost is 15 m away at 3 s.
    lists = [entry(11), entry(20, 2), NOTHING, one_list(entry(40), entry(0, 15))]
    of = assessed(
        lists, places={CAR: [(10, 0), (20, 0), (30, 0), (40, 0)]}, episodes={CAR: (1, 3)},
        distance_edges_m=(0.0, 20.0, 40.0), time_edges_s=(1.0, 3.0, 9.0),
    )  # fmt: skip
    near, middle = of.by_distance[0]
    assert (near["pairs"], near["looked"], near["missed"], near["ghosts"]) == (1, 0, 0, 1)
    assert (middle["pairs"], middle["looked"], middle["missed"], middle["ghosts"]) == (1, 2, 1, 0)
    assert (near["east_m"], near["square_m2"], near["nees"]) == (1.0, 1.0, 1.0)
    assert (middle["north_m"], middle["square_m2"]) == (2.0, 4.0)
    early, late = of.by_time[0]
    assert (early["pairs"], early["looked"], early["missed"], early["ghosts"]) == (1, 2, 1, 0)
    assert (late["pairs"], late["looked"], late["missed"], late["ghosts"]) == (1, 1, 0, 1)


def test_no_episodes_no_lists() -> None:
    of = assessed([entry(50), entry(0)], [NOTHING, NOTHING], places={}, episodes={})
    assert of.by_object.shape == (2, 0)
    assert of.error_m.shape == (2, 0)
    assert of.by_run["ghosts"].tolist() == [1, 0]
    assert figure("false_positives_per_min", of) == pytest.approx(30.0)  # 1 in 2 runs of 2 lists at 1 Hz: 1 s each
    assert all(figure(name, of) is None for name in ("gospa_m", "gospa_false_m", "ospa_m", "longest_gap_s"))
    of = assessed([], [], places={CAR: []}, episodes={CAR: (1, 3)})
    assert of.error_m.shape == of.gospa.shape == (2, 0)
    assert of.by_object["longest_gap_s"].tolist() == [[2.0], [2.0]]
    assert all(figure(name, of) is None for name in FIGURES if name != "longest_gap_s")


def test_a_log_of_ten_seconds_has_ten_seconds() -> None:
    """101 lists at 10 Hz, from 0.0 to 10.0 s, five ghosts in all: 30 in a minute."""
    lists = [entry(50) if k % 25 == 0 else NOTHING for k in range(101)]
    of = assessed(lists, times_s=[k / 10 for k in range(101)], places={}, episodes={})
    assert of.by_run[0]["time_s"] == pytest.approx(10.0)
    assert figure("false_positives_per_min", of) == pytest.approx(30.0)
    late = assessed(lists[5:], times_s=[k / 10 for k in range(5, 101)], places={}, episodes={})
    assert late.by_run[0]["time_s"] == pytest.approx(9.5)  # lists that come half a second late


def test_time_of_irregular_lists_and_of_one() -> None:
    of = assessed([entry(50)] * 4, times_s=[0, 1, 3, 4], ego=[(0, 0), (0, 0), None, (0, 0)], places={}, episodes={})
    assert of.by_run[0]["time_s"] == pytest.approx(1.0)  # three lists, the only neighbours 1 s apart
    assert figure("false_positives_per_min", assessed([entry(50)], places={}, episodes={})) is None


def test_totals_of_logs_add() -> None:
    first = assessed([entry(11)] * 2, places={CAR: standing(10, 0, 2)}, episodes={CAR: (0, 1)})
    other = assessed([entry(12)], [NOTHING], places={CAR: [(10, 0)], OTHER_CAR: [(20, 0)]}, episodes={CAR: (0, 0), 2: (0, 0)})  # fmt: skip # noqa: E501
    both = sum_accuracy([first]) + sum_accuracy([other])
    assert METRIC["position_rmse_m"].value(both) == pytest.approx(math.sqrt((1 + 1 + 4) / 3))
    assert (both.rows, both.matched_rows) == (5, 2)
    assert METRIC["gospa_m"].value(both) == pytest.approx(math.sqrt((1 + 1 + 4 + 3 * 4.5) / 4))
    with pytest.raises(ValueError, match="same settings"):
        sum_accuracy([first]) + sum_accuracy([assessed([entry(1)], places={}, episodes={}, cutoff_m=4.0)])


def test_one_run_that_stands_for_all_counts_as_often_as_there_are_runs() -> None:
    lists = [one_list(entry(11, existence=0.7), entry(50)), NOTHING]
    given: dict[str, Any] = {
        "places": {CAR: standing(10, 0, 2)}, "episodes": {CAR: (0, 1)}, "distance_edges_m": (0.0, 60.0),
        "time_edges_s": (0.0, 2.0), "existence_thresholds": (0.5,),
    }  # fmt: skip
    one, three = assessed(lists, **given), assessed(lists, lists, lists, **given)
    assert_same(repeat_for_runs(one, 3), three)
    assert_equal_totals(sum_accuracy([repeat_for_runs(one, 3)]), sum_accuracy([three]))
    assert repeat_for_runs(three, 3) is three


class Scenery:
    """A few objects that come and go, and lists of what may be they, drawn from a seed."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        S, K, N = int(rng.integers(1, 4)), int(rng.integers(0, 7)), int(rng.integers(1, 7))
        self.times = np.cumsum(rng.uniform(0.05, 0.5, K))
        self.captures = np.cumsum(rng.uniform(0.05, 0.5, 8)).tolist()
        home, self.velocity = rng.uniform(-6, 6, (N, 2)), {o: tuple(rng.normal(0, 2, 2)) for o in range(N)}

        def way(o: int, times: Sequence[float]) -> list[tuple[float, float] | None]:
            places = [tuple(home[o] + np.array(self.velocity[o]) * t) for t in times]
            return [place if rng.uniform() < 0.85 else None for place in places]

        self.places = {o: way(o, self.times.tolist()) for o in rng.permutation(N).tolist()}
        self.places_captured = {o: way(o, self.captures) for o in range(N)}
        self.scene = scene_of(*rng.choice(["car", "pedestrian", "truck"], N))
        watched = sorted(rng.permutation(np.arange(1, N))[: rng.integers(0, N)].tolist())
        onset = rng.uniform(0, 1.5, len(watched))
        span = rng.uniform(0, 2.5, len(watched))
        self.episodes = episodes_of({o: (a, a + d) for o, a, d in zip(watched, onset, span, strict=True)})
        self.since_s = onset - rng.choice([0.0, 0.3, -0.1], len(watched))
        self.reference = reference_of([None if rng.uniform() < 0.15 else tuple(rng.normal(0, 1, 2)) for _ in range(K)])
        self.measured = classes(*rng.choice(CLASSES, 8))
        self.lists = lists_of([[self._list(rng, k, way) for k in range(K)] for _ in range(S)])
        self.world = truth_of(self.places, self.times.tolist(), self.velocity)
        self.settings = AccuracySettings(
            cutoff_m=2.5, gate_m=2.0, power=float(rng.choice([1.0, 2.0, 3.0])),
            distance_edges_m=(0.0, 3.0, 6.0, np.inf), time_edges_s=(0.2, 1.0, 1.5),
            existence_thresholds=(0.25, 0.5, 0.9),
        )  # fmt: skip
        self.captured = truth_of(self.places_captured, self.captures)
        self.tells_of_now = bool(rng.uniform() < 0.3)
        self.found = self.matched(self.lists)
        self.rng = rng
        if rng.uniform() < 0.5:  # else annotated everywhere
            corners = tuple((4 * math.cos(a), 5 * math.sin(a)) for a in sorted(rng.uniform(0, 2 * math.pi, 4)))
            self.settings = replace(self.settings, annotated_m=corners if rng.uniform() < 0.7 else (),
                                    annotated_range_m=float(rng.choice([2.0, 5.0, np.inf])))  # fmt: skip

    def matched(self, lists: ObjectLists) -> tuple[Matches, Matches]:
        if self.tells_of_now:
            found = match_entries(lists, self.world, self.scene, unknown_origins(lists), gate_m=2.0)
            return found, found
        return match_at_both_times(lists, self.captured, self.world, self.scene, unknown_origins(lists), gate_m=2.0)

    def _list(self, rng: np.random.Generator, k: int, way: Any) -> Entries:
        found = [place for o in self.places if (place := self.places[o][k]) is not None and rng.uniform() < 0.8]
        again = [place for place in found if rng.uniform() < 0.3]
        ghosts = [tuple(rng.uniform(-8, 8, 2)) for _ in range(int(rng.integers(0, 3)))]
        entries = []
        for place in [*found, *again, *ghosts]:
            x, y = np.array(place) + rng.normal(0, 0.6, 2)
            root = rng.normal(0, 1, (2, 2))
            cov = root @ root.T
            entries.append(
                entry(
                    x, y, of=str(rng.choice(["car", "pedestrian", "vehicle", "other"])), existence=rng.uniform(),
                    cov=(cov[0, 0], cov[0, 1], cov[1, 1]), vx_mps=rng.normal(), vy_mps=rng.normal(),
                    captured_s=rng.choice([*self.captures, 0.0]) + rng.choice([0.0, 8e-7, -8e-7]),
                    track_id=rng.integers(-1, 3), unit_ix=rng.integers(-1, 3),
                )
            )  # fmt: skip
        return one_list(*entries)

    def of(self, lists: ObjectLists, found: tuple[Matches, Matches]) -> Accuracy:
        return assess(
            lists, *found, self.times, self.world, self.scene, self.episodes, self.since_s, self.reference,
            self.measured, settings=self.settings,
        )  # fmt: skip

    def in_chunks(self, cuts: Sequence[float]) -> Accuracy:
        """The same, fed with the lists between cuts, their matches, and their instants."""
        adding = Aggregator(
            self.times, self.scene, self.episodes, self.since_s, self.reference, self.measured, settings=self.settings,
            runs=len(self.lists.start),
        )  # fmt: skip
        for a, b in chunks(cuts, len(self.times)):
            lists, rows = between(self.lists, a, b)
            adding.add(
                lists, *(taken(one, rows) for one in self.found),
                truth_of({o: way[a:b] for o, way in self.places.items()}, self.times[a:b].tolist(), self.velocity),
            )  # fmt: skip
        return adding.result()


SQUARE = ((0.0, -5.0), (12.0, -5.0), (12.0, 5.0), (0.0, 5.0))


@pytest.mark.parametrize(
    ("area", "ghosts", "unannotated"),
    [
        ({}, 4, 0),
        ({"annotated_m": SQUARE}, 2, 2),  # of x = 10, 12 (on the edge), 13 and 30
        ({"annotated_range_m": 13.0}, 3, 1),
        ({"annotated_m": SQUARE, "annotated_range_m": 11.0}, 1, 3),
    ],
)
def test_where_the_truth_is_not_annotated_entries_are_no_ghosts(
    area: dict[str, Any], ghosts: int, unannotated: int
) -> None:
    """A car at 5 m, listed where it is; entries at no object at 10, 12, 13 and 30 m; that of a truck does not count."""
    said = one_list(*(entry(x, 0, existence=0.8) for x in (5, 10, 12, 13, 30)), entry(40, 0, of="truck"))
    found = assessed(
        [said], places={CAR: standing(5, 0, 1)}, episodes={CAR: (0, 0)}, existence_thresholds=(0.5,), **area
    )
    run = found.by_run[0]
    assert (run["ghosts"], run["unannotated"], found.ghosts_at[0, 0]) == (ghosts, unannotated, ghosts)
    # GOSPA of power 2 and cut-off 3: 4.5 for each false entry; OSPA: 9 of each, by the larger number.
    assert found.by_object[0, 0]["gospa_false"] == pytest.approx(4.5 * ghosts)
    assert run["ospa_m"] == pytest.approx(math.sqrt(9 * ghosts / (1 + ghosts)))
    assert found.by_existence[0]["entries"].sum() == 1 + ghosts
    assert found.by_existence[0]["with_object"].sum() == 1


def test_an_entry_at_an_object_counts_wherever_it_is() -> None:
    """Beyond the area a car is annotated all the same: its entry is its match, and GOSPA has no miss."""
    found = assessed(
        [entry(20.5, 0)], places={CAR: standing(20, 0, 1)}, episodes={CAR: (0, 0)}, annotated_m=SQUARE
    )  # fmt: skip
    assert (found.by_object[0, 0]["pairs"], found.by_run[0]["unannotated"]) == (1, 0)
    assert found.by_object[0, 0]["gospa_localisation"] == pytest.approx(0.25)


def test_a_stale_entry_where_now_nothing_is_annotated() -> None:
    """Of 1 s ago, when the car was there; now it has left it, and its entry, outside, is no ghost, stale or not."""
    said = entry(15, 0, captured_s=-1.0)
    captures = [-1.0], {CAR: standing(15, 0, 1)}
    given: dict[str, Any] = {"places": {CAR: standing(30, 0, 1)}, "episodes": {CAR: (-2, 0)}, "captures": captures}
    everywhere, inside = (assessed([said], **given, **area).by_run[0] for area in ({}, {"annotated_m": SQUARE}))
    assert (everywhere["ghosts"], everywhere["stale_ghosts"], everywhere["unannotated"]) == (0, 1, 0)
    assert (inside["ghosts"], inside["stale_ghosts"], inside["unannotated"]) == (0, 0, 1)


_OF_FEWER_STEPS = ("nees_expected", "nees_square_expected", "beyond_gate")
"""Integrals over the directions of an error: of half as many where the ellipse is nearly round, to five digits."""


def assert_same(found: Accuracy, expected: Accuracy, *, exactly: bool = True) -> None:
    for column in (f.name for f in fields(Accuracy) if f.name != "settings"):
        got, want = getattr(found, column), getattr(expected, column)
        assert got.shape == want.shape, column
        for name in got.dtype.names or (None,):
            a, b = (got, want) if name is None else (got[name], want[name])
            if exactly:
                np.testing.assert_array_equal(a, b, err_msg=f"{column} {name}")
            else:
                digits = 2e-5 if name in _OF_FEWER_STEPS else 1e-6
                np.testing.assert_allclose(a, b, rtol=digits, atol=1e-9, err_msg=f"{column} {name}")


def assert_equal_totals(found: AccuracyTotal, expected: AccuracyTotal) -> None:
    for column in (f.name for f in fields(AccuracyTotal) if f.name != "settings"):
        got, want = np.asarray(getattr(found, column)), np.asarray(getattr(expected, column))
        assert (got.dtype, got.shape, got.tobytes()) == (want.dtype, want.shape, want.tobytes()), column


@given(st.integers(0, 2**32 - 1))
def test_sums_as_the_sentences_have_them(seed: int) -> None:
    made = Scenery(seed)
    found = made.of(made.lists, made.found)
    expected = plainly(
        made.lists, *made.found, made.times, made.places, made.velocity,
        None if made.tells_of_now else made.captures, made.places_captured,
        made.episodes, made.since_s, made.reference, made.measured, made.settings,
    )  # fmt: skip
    assert_same(found, expected, exactly=False)


@given(st.integers(0, 2**32 - 1))
def test_runs_by_themselves_are_those_of_all_and_the_order_of_entries_does_not_matter(seed: int) -> None:
    made = Scenery(seed)
    whole = made.of(made.lists, made.found)
    parts = []
    for s in range(len(made.lists.start)):
        lists, its = one_run(made.lists, s)
        parts.append(made.of(lists, (taken(made.found[0], its), taken(made.found[1], its))))
        assert_same(parts[s], whole.of_run(s))
    assert_equal_totals(sum_accuracy(parts), sum_accuracy([whole]))
    shuffled, _, _ = permuted(made.lists, None, made.rng)
    assert_same(made.of(shuffled, made.matched(shuffled)), whole, exactly=False)


@given(st.integers(0, 2**32 - 1), st.lists(st.floats(0, 1), max_size=6))
def test_chunks_add_up_to_the_whole_to_the_last_bit(seed: int, cuts: list[float]) -> None:
    made = Scenery(seed)
    assert_same(made.in_chunks(cuts), made.of(made.lists, made.found))


def test_what_is_known_and_as_which_track_goes_on_over_a_cut() -> None:
    lists = [entry(10, track_id=5), NOTHING, NOTHING, entry(10, track_id=7)]
    made = Scenery(0)
    made.times, made.lists = np.arange(4.0), lists_of([lists])
    made.places, made.velocity = {EGO: standing(0, 0, 4), CAR: standing(10, 0, 4)}, {}
    made.scene, made.episodes, made.since_s = scene_of("car", "car"), episodes_of({CAR: (0, 3)}), np.zeros(1)
    made.reference = reference_of(standing(0, 0, 4))
    made.world = truth_of(made.places, made.times.tolist())
    made.tells_of_now = True
    made.found = made.matched(made.lists)
    sums = made.in_chunks([0.5]).by_object[0, 0]
    assert (sums["switches"], sums["longest_gap_s"]) == (1, 2.0)


def test_lists_too_many_or_too_few_are_a_defect() -> None:
    made = Scenery(1)
    none = truth_of({}, [])
    adding = Aggregator(
        np.arange(2.0), made.scene, made.episodes, made.since_s, reference_of([None, None]), made.measured,
        settings=made.settings, runs=1,
    )  # fmt: skip
    no_matches = matches_of([], [])
    with pytest.raises(ValueError, match="expected 2 lists, found 0"):
        adding.result()
    with pytest.raises(ValueError, match="expected lists of 1 runs, at most 2 of each; found 1 runs of 3"):
        adding.add(lists_of([[NOTHING] * 3]), no_matches, no_matches, none)
    with pytest.raises(ValueError, match="found 2 runs of 1"):
        adding.add(lists_of([[NOTHING]] * 2), no_matches, no_matches, none)


@pytest.mark.parametrize("cut", [1, 7, 199])
def test_blocks_of_many_runs_are_summed_as_the_whole_to_the_last_bit(cut: int) -> None:
    # Of so many numbers NumPy adds up pairs of pairs, and sums of sums would round otherwise.
    rng = np.random.default_rng(3)
    runs = [[entry(*(10 + rng.normal(0, 0.7, 2)), existence=rng.uniform()) for _ in range(2)] for _ in range(200)]
    given: dict[str, Any] = {
        "places": {CAR: standing(10, 10, 2)}, "episodes": {CAR: (0, 1)}, "distance_edges_m": (0.0, 60.0),
        "time_edges_s": (0.0, 2.0), "existence_thresholds": (0.5,),
    }  # fmt: skip
    whole = assessed(*runs, **given)
    blocks = [assessed(*runs[s : s + cut], **given) for s in range(0, len(runs), cut)]
    assert_equal_totals(sum_accuracy(blocks), sum_accuracy([whole]))


def tree(values: list[float]) -> float:
    """The sum of the leaves of a tree that is complete but for its right end: halves of the next power of two."""
    if len(values) == 1:
        return values[0]
    half = 1 << (len(values) - 1).bit_length() - 1
    return tree(values[:half]) + tree(values[half:])


@pytest.mark.parametrize("runs", [1, 2, 3, 5, 8, 11, 13])
@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_runs_add_up_as_the_leaves_of_a_tree(runs: int, step: int) -> None:
    """However they are grouped: sums of neighbouring runs are parts of the sum of all."""
    rng = np.random.default_rng(runs)
    off_m = [[rng.normal(0, 0.7, 2).tolist() for _ in range(2)] for _ in range(runs)]
    given: dict[str, Any] = {"places": {CAR: standing(10, 10, 2)}, "episodes": {CAR: (0, 1)}}
    of_runs = [assessed([entry(10 + x, 10 + y) for x, y in of_run], **given) for of_run in off_m]
    expected = tree([float(one.by_object["square_m2"][0, 0]) for one in of_runs])
    whole = sum_accuracy(of_runs)
    assert whole.episodes["square_m2"] == expected
    borders = [k for k in (0, *(1 << e for e in range(4))) if k <= step] + list(range(2 * step, runs, step))
    borders = [k for k in borders if k < runs] + [runs]
    pieces = [(b - a, sum_accuracy(of_runs[a:b])) for a, b in pairwise(borders)]
    assert_equal_totals(join_totals(pieces), whole)


@given(st.integers(0, 2**32 - 1))
def test_parts_of_objects_add_up_to_gospa(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, shown = rng.uniform(0, 12, (4, 2)), rng.uniform(0, 12, (int(rng.integers(0, 7)), 2))
    of = assessed(
        [one_list(*(entry(x, y) for x, y in shown))], places={o + 1: [tuple(truth[o])] for o in range(4)},
        episodes={o + 1: (0, 0) for o in range(4)}, of=["car"] * 5, ego=[(-50, 0)],
    )  # fmt: skip
    expected = gospa(truth, shown, cutoff_m=3.0, power=2.0)
    assert figure("gospa_m", of) == pytest.approx(expected.value_m)
    assert of.gospa.sum() == pytest.approx(expected.value_m**2, rel=1e-5)
    assert figure("gospa_localisation_m", of) == pytest.approx(math.sqrt(expected.localisation))
    assert figure("gospa_missed_m", of) == pytest.approx(math.sqrt(expected.missed))
    assert figure("gospa_false_m", of) == pytest.approx(math.sqrt(expected.false))
    assert figure("ospa_m", of) == pytest.approx(ospa(truth, shown, cutoff_m=3.0, power=2.0))
