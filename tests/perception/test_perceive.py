"""What each unit lists: frequencies, independence, and errors that come after the decision and leave it alone."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from copem_replay.core.tracks import VALUES, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.perception.observation import Observations, observe_objects
from copem_replay.perception.perceive import perceive
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

RUNS = np.arange(20_000)
"""Enough to see a per cent of a per cent."""


def sees(probability: float, error: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    couple: dict[str, Any] = {"detection": {"kind": "constant", "probability": probability}}
    return [couple | ({"error": error} if error else {})]


def gaussian(covariance_m2: list[list[float]], **more: Any) -> dict[str, Any]:
    return {"kind": "gaussian", "covariance_m2": covariance_m2} | more


def square(frames: int = 1) -> Recording:
    """The ego stands at the origin, a car 10 m ahead drives at 5 m/s to the left, a walker stands 8 m to the left."""
    return recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("car", "car", driving(10, 0, 0, 5.0), yaw_rad=math.pi / 2),
            Thing("walker", "pedestrian", standing(0, 8), yaw_rad=3.1),
        ],
        until_s=(frames - 1) / 10,
    )


def two_units(**pems: Any) -> Experiment:
    """One unit on the ego, one on a mast, each with the PEM of its name."""
    return experiment(
        pems=pems,
        units={"ego": EGO_UNIT | {"pem": "ego"}, "mast": {"at": [3, 3], "height_m": 6.0, "pem": "mast"}},
        configurations={"all": {"units": "all"}},
    )


def seen(
    log: Recording,
    plan: Experiment,
    runs: npt.NDArray[np.int64] = RUNS,
    states: Literal["true", "expected", "sampled"] = "sampled",
) -> tuple[Observations, Tracks]:
    found = observe_objects(log.scene, log.truth, plan)
    return found, perceive(log.scene, found, plan, runs, states=states)


def who(log: Recording, of: Tracks) -> list[tuple[str, str, int]]:
    """Unit, object and list of each row; lists counted by the unit from 0."""
    first = [int(np.flatnonzero(of.frame_unit_ix == u)[0]) for u in range(len(of.units))]
    return [
        (of.units[u], log.scene.object_ids[o], int(f) - first[u])
        for u, o, f in zip(of.row_unit_ix, of.row_object_ix, of.frame_ix, strict=True)
    ]


class TestWhoIsListed:
    def test_everything_but_ones_own_carrier_is_a_candidate(self) -> None:
        log = square(frames=2)
        _, of = seen(log, two_units(ego=sees(1.0), mast=sees(1.0)), np.arange(1))
        assert sorted(who(log, of)) == sorted(
            [("ego", o, k) for o in ("car", "walker") for k in (0, 1)]
            + [("mast", o, k) for o in ("ego", "car", "walker") for k in (0, 1)]
        )

    def test_never_and_always(self) -> None:
        log = square(frames=4)
        _, of = seen(log, two_units(ego=sees(0.0), mast=sees(1.0)))
        assert np.array_equal(of.valid, np.broadcast_to(of.row_unit_ix == 1, of.valid.shape))
        assert of.valid.size == 20_000 * 20

    def test_what_no_couple_covers_is_not_detected(self) -> None:
        near = [{"when": {"range_m": [0, 9]}, "detection": {"kind": "constant", "probability": 1.0}}]
        log = square()
        _, of = seen(log, experiment(pems={"near": near}, units={"ego": EGO_UNIT | {"pem": "near"}}), np.arange(50))
        listed = {name for (_, name, _), always in zip(who(log, of), of.valid.all(axis=0), strict=True) if always}
        assert listed == {"walker"}
        assert of.valid.any(axis=0).sum() == 1

    @pytest.mark.parametrize("probability", [0.001, 0.1, 0.5, 0.85, 0.999])
    def test_frequencies(self, probability: float) -> None:
        """Each row's count in 20 000 runs is what chance gives in all but one of a million cases."""
        log = square(frames=3)
        _, of = seen(log, two_units(ego=sees(probability), mast=sees(probability)))
        low, high = stats.binom.ppf([5e-7, 1 - 5e-7], len(RUNS), probability)
        counts = of.valid.sum(axis=0)
        assert len(counts) == 15
        assert low <= counts.min()
        assert counts.max() <= high
        total = int(of.valid.sum())
        assert stats.binomtest(total, of.valid.size, probability).pvalue > 1e-6

    def test_the_visible_share_is_the_probability(self) -> None:
        """A wall as high as the walker hides all but his left half, seen flat."""
        log = recording(
            [
                Thing("ego", "car", standing(0, 0)),
                Thing("walker", "pedestrian", standing(20, 0)),
                Thing("wall", "other", standing(19.0, -5.0), size_m=(0.01, 10.0, 4.0), moving=False),
            ],
            until_s=0.0,
        )
        plan = experiment(visibility="flat", pems={"sure": [{"detection": {"kind": "visible_share"}}]})
        found, of = seen(log, plan)
        (row,) = np.flatnonzero(of.row_object_ix == 1)
        share = found.view.visible_share[row]
        assert share == pytest.approx(0.5, abs=1e-3)
        low, high = stats.binom.ppf([5e-7, 1 - 5e-7], len(RUNS), share)
        assert low <= of.valid[:, row].sum() <= high

    def test_runs_units_objects_and_lists_are_independent(self) -> None:
        """Correlations of pairs of rows, and of neighbouring runs, of 20 000 fair coins: all within 5/√20 000."""
        log = square(frames=3)
        _, of = seen(log, two_units(ego=sees(0.5), mast=sees(0.5)))
        coins = of.valid * 2.0 - 1.0
        bound = 5 / math.sqrt(len(RUNS))
        between = coins.T @ coins / len(RUNS)
        assert np.abs(between - np.eye(between.shape[0])).max() < bound
        assert np.abs((coins[1:] * coins[:-1]).mean(axis=0)).max() < bound
        for three in combinations(range(6), 3):
            assert abs(coins[:, three].prod(axis=1).mean()) < bound


ERRORS: dict[str, dict[str, Any] | None] = {
    "none": None,
    "round": gaussian([[1.0, 0.0], [0.0, 1.0]]),
    "all": gaussian(
        [[2.0, 0.7], [0.7, 0.5]], mean_m=[1, -1], frame="line_of_sight",
        yaw_sigma_deg=20.0, size_sigma_m=1.5, speed_sigma_mps=2.0,
    ),
}  # fmt: skip


class TestErrors:
    def test_detections_do_not_depend_on_the_error(self) -> None:
        log = square(frames=2)
        listed = [seen(log, two_units(ego=sees(0.4, e), mast=sees(0.7)))[1].valid for e in ERRORS.values()]
        listed += [
            seen(log, two_units(ego=sees(0.4, ERRORS["all"]), mast=sees(0.7)), states=states)[1].valid
            for states in ("true", "expected", "sampled")
        ]
        for other in listed[1:]:
            assert np.array_equal(listed[0], other)

    def test_errors_do_not_depend_on_what_detects(self) -> None:
        """The error of a row listed with either probability is the same draw."""
        log = square(frames=2)
        often = seen(log, two_units(ego=sees(0.8, ERRORS["all"]), mast=sees(0.9)))[1]
        rarely = seen(log, two_units(ego=sees(0.3, ERRORS["all"]), mast=sees(0.2)))[1]
        both = often.valid & rarely.valid
        assert both.any(axis=0).all()
        for name in VALUES:
            a, b = (np.broadcast_to(getattr(of, name), both.shape)[both] for of in (often, rarely))
            assert np.array_equal(a, b)

    @pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
    @pytest.mark.parametrize("states", ["true", "expected", "sampled"])
    def test_no_nan_under_valid(self, error: dict[str, Any] | None, states: Any) -> None:
        _, of = seen(square(frames=3), two_units(ego=sees(0.5, error), mast=sees(0.5)), np.arange(200), states)
        for name in (*VALUES, "cov_ee_m2", "cov_en_m2", "cov_nn_m2", "yaw_var_rad2", "size_var_m2", "speed_var_m2ps2"):
            column = getattr(of, name)
            assert column is None or np.isfinite(np.broadcast_to(column, of.valid.shape)[of.valid]).all()

    def test_without_error_model_the_state_is_exact(self) -> None:
        """Bit for bit, also where another unit of the experiment has errors."""
        log = square(frames=3)
        _, of = seen(log, two_units(ego=sees(0.5), mast=sees(0.5, ERRORS["all"])), np.arange(100))
        exact = 0
        for p, (unit, name, k) in enumerate(who(log, of)):
            if unit != "ego":
                continue
            o = log.scene.object_ids.index(name)
            (row,) = np.flatnonzero((log.truth.row_object_ix == o) & (log.truth.frame_ix == k))
            for value in VALUES:
                assert (getattr(of, value)[:, p] == getattr(log.truth, value)[0, row]).all()
            exact += 1
            for spread in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2", "yaw_var_rad2", "size_var_m2", "speed_var_m2ps2"):
                assert (getattr(of, spread)[:, p] == 0).all()
        assert exact == 6

    def test_what_is_listed_has_the_whole_law(self) -> None:
        """The deciding draw is another than the error's: errors of what was listed with 0.5 are not cut off."""
        log = square()
        found, of = seen(log, two_units(ego=sees(0.5, gaussian([[4.0, 0.0], [0.0, 0.25]])), mast=sees(0.5)))
        (row,) = np.flatnonzero((of.row_unit_ix == 0) & (of.row_object_ix == 2))
        listed = of.valid[:, row]
        east = (of.x_m[listed, row] - found.tracks.x_m[0, row]) / 2.0
        north = (of.y_m[listed, row] - found.tracks.y_m[0, row]) / 0.5
        for sample in (east, north):
            assert stats.kstest(sample, "norm").pvalue > 1e-3
        assert abs(np.corrcoef(east, north)[0, 1]) < 5 / math.sqrt(len(east))

    def test_errors_of_runs_units_objects_and_lists_are_independent(self) -> None:
        log = square(frames=2)
        error = ERRORS["round"]
        _, of = seen(log, two_units(ego=sees(1.0, error), mast=sees(1.0, error)))
        off = np.concatenate([of.x_m - of.x_m.mean(axis=0), of.y_m - of.y_m.mean(axis=0)], axis=1)
        assert off.shape == (20_000, 20)
        bound = 5 / math.sqrt(len(RUNS))
        assert np.abs(off.T @ off / len(RUNS) - np.eye(20)).max() < math.sqrt(2) * bound
        assert np.abs((off[1:] * off[:-1]).mean(axis=0)).max() < bound

    def test_expected_states_are_off_by_the_mean(self) -> None:
        """Mean 2 m along and 1 m to the left of the line of sight: for the walker due north, 2 m north, 1 m west."""
        error = gaussian([[1.0, 0.0], [0.0, 1.0]], mean_m=[2, 1], frame="line_of_sight", yaw_sigma_deg=10.0)
        log = square()
        _, of = seen(log, two_units(ego=sees(1.0, error), mast=sees(1.0)), np.arange(3), "expected")
        for p, (unit, name, _) in enumerate(who(log, of)):
            if (unit, name) == ("ego", "walker"):
                np.testing.assert_allclose(of.x_m[:, p], -1.0)
                np.testing.assert_allclose(of.y_m[:, p], 10.0)
                np.testing.assert_allclose(of.yaw_rad[:, p], 3.1)
            if (unit, name) == ("ego", "car"):
                np.testing.assert_allclose(of.x_m[:, p], 12.0)
                np.testing.assert_allclose(of.y_m[:, p], 1.0)

    def test_yaw_size_and_speed(self) -> None:
        """Each with its own standard deviation; the car's speed error is along its way north, and nothing across it."""
        log = square()
        error = gaussian([[0, 0], [0, 0]], yaw_sigma_deg=9.0, size_sigma_m=0.1, speed_sigma_mps=2.0)
        found, of = seen(log, two_units(ego=sees(1.0, error), mast=sees(1.0)))
        (car,) = np.flatnonzero((of.row_unit_ix == 0) & (of.row_object_ix == 1))
        (walker,) = np.flatnonzero((of.row_unit_ix == 0) & (of.row_object_ix == 2))
        samples = [
            (of.vy_mps[:, car] - 5.0) / 2.0,
            (of.length_m[:, car] - 4.0) / 0.1,
            (of.width_m[:, car] - 2.0) / 0.1,
            (of.height_m[:, car] - 1.5) / 0.1,
            (of.yaw_rad[:, car] - math.pi / 2) / (math.pi / 20),
        ]
        for sample in samples:
            assert stats.kstest(sample, "norm").pvalue > 1e-3
        assert np.abs(np.corrcoef(samples) - np.eye(5)).max() < 5 / math.sqrt(len(RUNS))
        np.testing.assert_allclose(of.vx_mps[:, car], 0.0, atol=1e-9)
        np.testing.assert_array_equal(of.x_m[:, car], found.tracks.x_m[0, car])
        # The walker stands, so that there is no way to be along: it is his heading, 3.1 rad.
        speed = of.vx_mps[:, walker] / math.cos(3.1)
        np.testing.assert_allclose(of.vy_mps[:, walker], speed * math.sin(3.1), atol=1e-9)
        assert stats.kstest(speed / 2.0, "norm").pvalue > 1e-3
        # His yaw is near π: some errors carry it round.
        turned = of.yaw_rad[:, walker]
        assert turned.min() < -3
        assert turned.max() <= math.pi
        assert turned.min() > -math.pi
        error_rad = (turned - 3.1 + math.pi) % (2 * math.pi) - math.pi
        assert stats.kstest(error_rad / (math.pi / 20), "norm").pvalue > 1e-3

    def test_no_box_is_turned_inside_out(self) -> None:
        log = square()
        error = gaussian([[0, 0], [0, 0]], size_sigma_m=3.0)
        _, of = seen(log, two_units(ego=sees(1.0, error), mast=sees(1.0)))
        for name in ("length_m", "width_m", "height_m"):
            assert getattr(of, name).min() > 0
            assert getattr(of, name).max() > 10

    def test_each_couple_has_its_own_error(self) -> None:
        """Near: one metre east; far: one metre north; objects at 8 m and 10 m."""
        pem = [
            {"when": {"range_m": [0, 9]}} | sees(1.0, gaussian([[0, 0], [0, 0]], mean_m=[1, 0]))[0],
            {"when": {"range_m": [9, 99]}} | sees(1.0, gaussian([[0, 0], [0, 0.5]], mean_m=[0, 1]))[0],
        ]
        log = square()
        _, of = seen(log, two_units(ego=pem, mast=sees(1.0)), np.arange(1), "expected")
        at = {(u, o): (of.x_m[0, p], of.y_m[0, p], of.cov_nn_m2[0, p]) for p, (u, o, _) in enumerate(who(log, of))}  # type: ignore[index]
        assert at["ego", "walker"] == pytest.approx((1.0, 8.0, 0.0))
        assert at["ego", "car"] == pytest.approx((10.0, 1.0, 0.5))
        assert at["mast", "car"] == pytest.approx((10.0, 0.0, 0.0))


class TestHowItLooks:
    """The unit stands at (3, 3), turned to the north: the car at (10, 0), the walker at (0, 8), the ego at (0, 0)."""

    def test_from_a_fixed_place(self) -> None:
        log = square()
        plan = experiment(
            units={"mast": {"at": [3, 3], "yaw_deg": 90, "height_m": 6.0, "pem": "all"}},
            configurations={"all": {"units": "all"}},
        )
        found = observe_objects(log.scene, log.truth, plan)
        for p, (_, name, _) in enumerate(who(log, found.tracks)):
            dx, dy = {"car": (7, -3), "walker": (-3, 5), "ego": (-3, -3)}[name]
            assert found.view.range_m[p] == pytest.approx(math.hypot(dx, dy))
            assert found.view.bearing_rad[p] == pytest.approx(math.atan2(dy, dx))
            # Forward is north (dy), left is west (−dx).
            assert found.view.azimuth_rad[p] == pytest.approx(math.atan2(-dx, dy))
            assert found.view.speed_mps[p] == pytest.approx(5.0 if name == "car" else 0.0)

    def test_from_a_carrier_with_an_offset(self) -> None:
        """On the car, which heads north from (10, 0): 2 m forward and 1 m left is (9, 2); it looks backwards."""
        log = square()
        unit = {"on": "car", "offset_m": [2.0, 1.0], "yaw_deg": 180, "height_m": 1.0, "pem": "all"}
        found = observe_objects(
            log.scene, log.truth, experiment(units={"obu": unit}, configurations={"a": {"units": "all"}})
        )
        names = [name for _, name, _ in who(log, found.tracks)]
        assert sorted(names) == ["ego", "walker"]
        p = names.index("walker")
        assert found.view.range_m[p] == pytest.approx(math.hypot(9, 6))
        # Backwards is south, so its left is east: the walker is 6 m behind and 9 m to the right.
        assert found.view.azimuth_rad[p] == pytest.approx(math.atan2(-9, -6))


class TestAddressing:
    def test_a_block_of_runs_is_the_same_as_all(self) -> None:
        log, plan = square(frames=2), two_units(ego=sees(0.5, ERRORS["all"]), mast=sees(0.5, ERRORS["round"]))
        every, some = seen(log, plan, np.arange(40))[1], seen(log, plan, np.array([33, 7, 8]))[1]
        for name in ("valid", *VALUES):
            whole = np.broadcast_to(getattr(every, name), every.valid.shape)
            assert np.array_equal(np.broadcast_to(getattr(some, name), some.valid.shape), whole[[33, 7, 8]])

    def test_fewer_objects_draw_the_same(self) -> None:
        log, plan = square(frames=2), two_units(ego=sees(0.5, ERRORS["all"]), mast=sees(0.5))
        found = observe_objects(log.scene, log.truth, plan)
        every = perceive(log.scene, found, plan, np.arange(40))
        walker = perceive(log.scene, found.of_objects(np.array([2])), plan, np.arange(40))
        rows = every.row_object_ix == 2
        assert np.array_equal(walker.valid, every.valid[:, rows])
        assert np.array_equal(walker.x_m, every.x_m[:, rows])

    def test_another_seed_or_log_has_other_dice(self) -> None:
        log, plan = square(frames=2), two_units(ego=sees(0.5), mast=sees(0.5))
        renamed = replace(log, scene=replace(log.scene, log="another"))
        first = seen(log, plan)[1].valid
        for other in (seen(renamed, plan)[1].valid, seen(log, plan.model_copy(update={"seed": 8}))[1].valid):
            assert abs((first == other).mean() - 0.5) < 5 * 0.5 / math.sqrt(first.size)


class TestEquipped:
    def test_a_unit_that_a_run_does_not_have_lists_nothing_in_it(self) -> None:
        log, plan = square(frames=2), two_units(ego=sees(1.0), mast=sees(1.0))
        found = observe_objects(log.scene, log.truth, plan)
        there = np.array([[True, True], [True, False], [False, True], [False, False]])
        of = perceive(log.scene, found, plan, np.arange(4), equipped=there)
        for run, (ego, mast) in enumerate(there.tolist()):
            listed = {of.units[u] for u in of.row_unit_ix[of.valid[run]]}
            assert listed == {name for name, has in (("ego", ego), ("mast", mast)) if has}

    @pytest.mark.parametrize("states", ["expected", "sampled"])
    def test_each_unit_states_its_own_covariance(self, states: Literal["expected", "sampled"]) -> None:
        own, others = [[1.0, 0.3], [0.3, 0.5]], [[4.0, -1.0], [-1.0, 2.0]]
        plan = two_units(ego=sees(1.0, gaussian(own)), mast=sees(1.0, gaussian(others)))
        _, of = seen(square(), plan, np.arange(3), states)
        assert of.cov_ee_m2 is not None
        assert of.cov_en_m2 is not None
        assert of.cov_nn_m2 is not None
        stated = np.stack([of.cov_ee_m2[0], of.cov_en_m2[0], of.cov_nn_m2[0]], axis=1)
        for unit, expected in ((0, [1.0, 0.3, 0.5]), (1, [4.0, -1.0, 2.0])):
            rows = np.flatnonzero(of.row_unit_ix == unit)
            assert len(rows) >= 2
            assert stated[rows].tolist() == [expected] * len(rows)
