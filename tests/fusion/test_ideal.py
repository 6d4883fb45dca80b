"""The ideal fusion against Σ = (Σₙ Σₙ⁻¹)⁻¹, μ = Σ · Σₙ Σₙ⁻¹ μₙ written out with numpy, and its lists against words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.communication.link import ConstantLink, UnitLinks, transmit
from copem_replay.core.tracks import UNCERTAINTIES, VALUES, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.ideal import draw_posterior, fuse_ideal
from copem_replay.io.recording import Recording
from copem_replay.perception.observation import observe_objects
from copem_replay.perception.perceive import perceive
from tests.helpers.scenes import EGO_UNIT, Thing, experiment, recording, standing

Array = npt.NDArray[np.float64]
Says = dict[str, Any]
"""What a list says of one object: values, uncertainties, `valid`; by run where it is a sequence."""
ObjectLists = list[tuple[float, dict[int, Says]]]
"""A unit's lists: captured when, and what it says of which object."""

USUAL: Says = dict.fromkeys(VALUES, 0.0) | dict.fromkeys(UNCERTAINTIES, 0.0) | {"valid": True}
USUAL |= {"length_m": 1.0, "width_m": 1.0, "height_m": 1.0, "cov_ee_m2": 1.0, "cov_nn_m2": 1.0}


def received(units: dict[str, ObjectLists], latency_s: dict[str, float] | None = None, runs: int = 1) -> Tracks:
    """The lists of `units` as tracks, in the order of the units; without `latency_s` they arrive as captured."""
    frames = [(unit, k) for unit in units for k in range(len(units[unit]))]
    start, unit_ix, object_ix, frame_ix = [0], [], [], []
    rows: list[Says] = []
    for u, (unit, its) in enumerate(units.items()):
        for o in sorted({o for _, held in its for o in held}):
            for k, (_, held) in enumerate(its):
                if o in held:
                    rows.append(USUAL | held[o])
                    frame_ix.append(frames.index((unit, k)))
            start.append(len(rows))
            unit_ix.append(u)
            object_ix.append(o)
    captured_s = np.array([units[unit][k][0] for unit, k in frames])
    late_s = np.array([(latency_s or {}).get(unit, 0.0) for unit, _ in frames])

    def column(name: str, count: int) -> Any:
        return np.array([np.broadcast_to(row[name], (count,)) for row in rows]).reshape(len(rows), count).T.copy()

    values = {name: column(name, runs) for name in VALUES} | {name: column(name, 1) for name in UNCERTAINTIES}
    return Tracks(
        units=tuple(units),
        start=np.array(start),
        unit_ix=np.array(unit_ix, dtype=int),
        object_ix=np.array(object_ix, dtype=int),
        frame_ix=np.array(frame_ix, dtype=int),
        stamp_ns=np.rint(captured_s * 1e9).astype(np.int64),
        captured_s=captured_s,
        frame_unit_ix=np.array([list(units).index(unit) for unit, _ in frames], dtype=int),
        arrives_s=(captured_s + late_s)[None],
        valid=column("valid", runs).astype(bool),
        **values,
    )


def issued(of: Tracks, max_age_s: float = 1.0, **more: Any) -> list[dict[str, Any]]:
    """The fused lists: when issued, captured when, and what each says of each object in the first run."""
    fused = fuse_ideal(of, max_age_s=max_age_s, **more).fused
    found: list[dict[str, Any]] = [
        {"at": float(at), "captured": float(captured), "stamp": int(stamp), "holds": {}}
        for at, captured, stamp in zip(fused.arrives_s[0], fused.captured_s, fused.stamp_ns, strict=True)
    ]
    for p, (o, f) in enumerate(zip(fused.row_object_ix, fused.frame_ix, strict=True)):
        if fused.valid[0, p]:
            columns = {name: getattr(fused, name) for name in (*VALUES, *UNCERTAINTIES)}
            assert o not in found[f]["holds"]
            found[f]["holds"][int(o)] = {name: float(c[0, p]) for name, c in columns.items() if c is not None}
    return found


def place(says: Says) -> tuple[float, float]:
    return says["x_m"], says["y_m"]


def covariance(says: Says) -> list[list[float]]:
    return [[says["cov_ee_m2"], says["cov_en_m2"]], [says["cov_en_m2"], says["cov_nn_m2"]]]


def gauss(x: float, y: float, c: Any, **more: Any) -> Says:
    """Position and its covariance."""
    return {"x_m": x, "y_m": y, "cov_ee_m2": c[0][0], "cov_en_m2": c[0][1], "cov_nn_m2": c[1][1]} | more


def combined(points: Sequence[Any], covariances: Sequence[Any]) -> tuple[Array, Array]:
    """The paper's equations as they stand."""
    total = np.linalg.inv(sum(np.linalg.inv(np.array(c)) for c in covariances))
    weighed = sum(np.linalg.inv(np.array(c)) @ np.array(p) for p, c in zip(points, covariances, strict=True))
    return total @ weighed, total


SMALL = [[1.0, 0.0], [0.0, 1.0]]
NONE = [[0.0, 0.0], [0.0, 0.0]]


def at_once(*said: Says) -> Says:
    """What is believed of an object of which several units say something at the same time."""
    (one,) = issued(received({f"u{k}": [(0.0, {0: s})] for k, s in enumerate(said)}))
    result: Says = one["holds"][0]
    return result


class TestWeights:
    @pytest.mark.parametrize(("n", "variance"), [(1, 1.0), (2, 0.5), (3, 0.3333), (5, 0.2), (21, 0.047619)])
    def test_n_identical_units(self, n: int, variance: float) -> None:
        found = at_once(*(gauss(k, -k, [[1, 0], [0, 1]]) for k in range(n)))
        np.testing.assert_allclose(covariance(found), [[variance, 0], [0, variance]], atol=1e-4)
        np.testing.assert_allclose(covariance(found), np.eye(2) / n, rtol=1e-12)
        assert place(found) == pytest.approx(((n - 1) / 2, -(n - 1) / 2))

    def test_published_vectors(self) -> None:
        """Inverse-variance results of the two examples named in the design notes (CARMA; MathWorks)."""
        found = at_once(gauss(1, 2, [[4, 0], [0, 5]]), gauss(4, 5, [[7, 0], [0, 8]]))
        assert place(found) == pytest.approx((2.090909, 3.153846), abs=1e-6)
        np.testing.assert_allclose(covariance(found), [[2.545455, 0], [0, 3.076923]], atol=1e-6)
        found = at_once(
            gauss(1, 2, [[10, 5], [5, 10]]), gauss(2, 2, [[10, -5], [-5, 10]]), gauss(2, 3, [[12, 9], [9, 12]])
        )
        assert place(found) == pytest.approx((1.525253, 2.414141), abs=1e-6)
        np.testing.assert_allclose(covariance(found), [[2.424242, 0.757576], [0.757576, 2.424242]], atol=1e-6)

    def test_long_errors_that_cross(self) -> None:
        """One unit knows the easting well, the other the northing: each is believed in what it knows."""
        found = at_once(gauss(1, 50, [[0.01, 0], [0, 100]]), gauss(60, 2, [[100, 0], [0, 0.01]]))
        assert place(found) == pytest.approx((1.0 + 59 * 0.01 / 100.01, 2.0 + 48 * 0.01 / 100.01))

    def test_a_unit_without_error_decides(self) -> None:
        found = at_once(gauss(10, 10, [[1, 0.5], [0.5, 1]]), gauss(3, 4, NONE), gauss(0, 0, SMALL))
        assert place(found) == pytest.approx((3, 4), abs=1e-6)

    @pytest.mark.parametrize("small", [0.0, 1e-12, 1e-9])
    def test_variances_below_the_floor_count_as_the_floor(self, small: float) -> None:
        """So two exact units weigh the same, and one of 3e-9 m² weighs a third."""
        c = [[small, 0], [0, small]]
        even = at_once(gauss(1, 0, NONE), gauss(3, 6, c))
        assert place(even) == pytest.approx((2, 3))
        np.testing.assert_allclose(covariance(even), np.eye(2) * 5e-10, rtol=1e-6)
        uneven = at_once(gauss(1, 0, [[3e-9, 0], [0, 3e-9]]), gauss(3, 6, c))
        assert place(uneven) == pytest.approx((2.5, 4.5))

    def test_no_uncertainty_given_at_all_is_exact(self) -> None:
        of = received({"a": [(0.0, {0: {"x_m": 1.0}})], "b": [(0.0, {0: {"x_m": 3.0}})]})
        of = replace(of, **dict.fromkeys(UNCERTAINTIES))
        assert issued(of)[0]["holds"][0]["x_m"] == pytest.approx(2.0)

    def test_singular_covariances(self) -> None:
        """Two units that err along the same diagonal only, and one that errs along the other."""
        rising, falling = [[1, 1], [1, 1]], [[1, -1], [-1, 1]]
        same = at_once(gauss(0, 0, rising), gauss(2, 2, rising))
        assert place(same) == pytest.approx((1, 1), abs=1e-6)
        np.testing.assert_allclose(covariance(same), [[0.5, 0.5], [0.5, 0.5]], atol=1e-6)
        crossing = at_once(gauss(5, 5, rising), gauss(3, -3, falling))
        assert place(crossing) == pytest.approx((0, 0), abs=1e-6)

    @pytest.mark.parametrize("size", [1.0, 1e2, 1e4, 1e6, 1e8])
    def test_large_singular_covariances(self, size: float) -> None:
        """However long the line along which units err: across it no eigenvalue is below 1e-12 of the other."""
        rising, low = [[size, size], [size, size]], max(1e-9, 2e-12 * size)
        alone = at_once(gauss(3, -4, rising))
        assert place(alone) == (3, -4)
        np.testing.assert_allclose(covariance(alone), rising, rtol=1e-6)
        small, large = np.linalg.eigvalsh(covariance(alone))
        assert (small, large) == (pytest.approx(low, rel=1e-3), pytest.approx(2 * size))
        same = at_once(gauss(0, 0, rising), gauss(2, 2, rising))
        assert place(same) == pytest.approx((1, 1), rel=1e-3)
        np.testing.assert_allclose(covariance(same), np.array(rising) / 2, rtol=1e-3)
        # One that errs by 1 m all round: along the line it decides, across it the others do.
        with_round = at_once(gauss(0, 0, rising), gauss(1, -1, SMALL))
        np.testing.assert_allclose(covariance(with_round), np.full((2, 2), size / (1 + 2 * size)), rtol=1e-3)
        assert place(with_round) == pytest.approx((0, 0), abs=1e-3)

    @pytest.mark.parametrize(
        "c", [[[0.7, 0.1], [0.1, 0.3]], [[4e8, 0.3], [0.3, 1.1e-3]], [[2e-9, 1e-10], [1e-10, 3e-9]]]
    )
    def test_what_one_unit_says_alone_stays_as_it_is(self, c: list[list[float]]) -> None:
        found = at_once(gauss(4e5 + 0.1, -5e6 + 0.3, c))
        assert place(found) == (4e5 + 0.1, -5e6 + 0.3)
        assert covariance(found) == c

    def test_far_from_the_origin_nothing_is_lost(self) -> None:
        found = at_once(gauss(4e5, 5e6, NONE), gauss(4e5 + 2e-3, 5e6 - 2e-3, NONE))
        assert place(found) == pytest.approx((4e5 + 1e-3, 5e6 - 1e-3), abs=1e-8)

    def test_the_rest_by_hand(self) -> None:
        """Variances 1 and 3: the first weighs three quarters. Height above ground by the mean."""
        a = gauss(0, 0, [[1, 0], [0, 1]], z_m=1, length_m=4, width_m=2, height_m=1, vx_mps=8, vy_mps=0,
                  size_var_m2=1.0, speed_var_m2ps2=3.0)  # fmt: skip
        b = gauss(0, 0, [[1, 0], [0, 1]], z_m=2, length_m=8, width_m=6, height_m=5, vx_mps=0, vy_mps=4,
                  size_var_m2=3.0, speed_var_m2ps2=1.0)  # fmt: skip
        found = at_once(a, b)
        names = ("z_m", "length_m", "width_m", "height_m", "vx_mps", "vy_mps", "size_var_m2", "speed_var_m2ps2")
        assert [found[name] for name in names] == pytest.approx([1.5, 5, 3, 2, 2, 3, 0.75, 0.75])

    @pytest.mark.parametrize(
        ("a_deg", "b_deg", "mean_deg"),
        [(10, 30, 20), (170, -170, 180), (-179, 177, 179), (178, -176, -179), (90, 90, 90), (-90, 0, -45)],
    )
    def test_yaw_is_averaged_on_the_circle(self, a_deg: float, b_deg: float, mean_deg: float) -> None:
        c = [[1, 0], [0, 1]]
        for variance in (0.0, 0.5):
            found = at_once(
                gauss(0, 0, c, yaw_rad=math.radians(a_deg), yaw_var_rad2=variance),
                gauss(0, 0, c, yaw_rad=math.radians(b_deg), yaw_var_rad2=variance),
            )
            off = (found["yaw_rad"] - math.radians(mean_deg) + math.pi) % (2 * math.pi) - math.pi
            assert abs(off) < 1e-12
        assert found["yaw_var_rad2"] == pytest.approx(0.25)

    def test_the_surer_yaw_weighs_more(self) -> None:
        """Weights 9 to 1 on unit vectors 4° either side of south: nine tenths of sin 4° remain short of the first."""
        c = [[1, 0], [0, 1]]
        found = at_once(
            gauss(0, 0, c, yaw_rad=math.radians(176), yaw_var_rad2=0.1),
            gauss(0, 0, c, yaw_rad=math.radians(-176), yaw_var_rad2=0.9),
        )
        assert found["yaw_rad"] == pytest.approx(math.pi - math.atan(0.8 * math.tan(math.radians(4))))


RUNS = np.arange(24_000)
ERRORS: dict[str, dict[str, Any]] = {
    "ego": {"covariance_m2": [[2.0, -1.2], [-1.2, 1.5]], "mean_m": [0.8, -0.3]},
    "mast": {"covariance_m2": [[4.0, 0.5], [0.5, 0.3]], "mean_m": [-1.0, 0.6], "frame": "line_of_sight"},
    "van": {"covariance_m2": [[0.6, 0.4], [0.4, 3.0]], "mean_m": [0.0, 2.0]},
}
WALKER = 1


def watched(until_s: float = 0.0) -> Recording:
    """The ego and a van stand some way from a walker who stands at (20, 5)."""
    return recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("walker", "pedestrian", standing(20, 5)),
            Thing("van", "car", standing(40, -20)),
        ],
        until_s=until_s,
    )


def three_units(probability: float) -> Experiment:
    """On the ego, on the van, and on a mast due south of the walker; each has its own error."""
    return experiment(
        pems={
            name: [
                {
                    "detection": {"kind": "constant", "probability": probability},
                    "error": {"kind": "gaussian"} | error,
                }
            ]
            for name, error in ERRORS.items()
        },
        units={
            "ego": EGO_UNIT | {"pem": "ego"},
            "mast": {"at": [20, -15], "height_m": 6.0, "pem": "mast"},
            "van": {"on": "van", "height_m": 2.0, "pem": "van"},
        },
        configurations={"all": {"units": "all"}},
    )


def laws() -> list[tuple[Array, Array]]:
    """Mean and covariance of each unit's error. Seen from the south: along is north, to the left is west."""
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    result = []
    for error in ERRORS.values():
        mean, c = np.array(error["mean_m"]), np.array(error["covariance_m2"])
        turned = error.get("frame") == "line_of_sight"
        result.append((quarter @ mean, quarter @ c @ quarter.T) if turned else (mean, c))
    return result


def run_tracks(probability: float, log: Recording, without: int = -1) -> dict[str, Tracks]:
    """What is believed in all runs, by either way of combining."""
    plan = three_units(probability)
    found = observe_objects(log.scene, log.truth, plan)
    result = {}
    for combine in ("samples", "posterior"):
        seen = perceive(log.scene, found, plan, RUNS, states="sampled" if combine == "samples" else "expected")
        fused_tracks = fuse_ideal(
            transmit(seen, [UnitLinks("link", ConstantLink())]), max_age_s=1.0, without_object_ix=without
        )
        drawn = draw_posterior(fused_tracks, log.scene, plan.seed, RUNS) if combine == "posterior" else fused_tracks
        result[combine] = drawn.fused
    return result


def whitened(offsets: Array, mean: Array, c: Array) -> Array:
    """Two standard normals per run, were the law N(mean, c): (2, S)."""
    result: Array = np.linalg.solve(np.linalg.cholesky(c), offsets - mean[:, None])
    return result


@pytest.fixture(scope="module")
def both() -> dict[str, Tracks]:
    return run_tracks(1.0, watched(until_s=0.1))


class TestLaw:
    def offsets(self, of: Tracks, frame: int = 0) -> Array:
        (row,) = np.flatnonzero((of.row_object_ix == WALKER) & (of.frame_ix == frame))
        assert of.valid[:, row].all()
        return np.stack([of.x_m[:, row] - 20.0, of.y_m[:, row] - 5.0])

    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_mean_and_covariance(self, both: dict[str, Tracks], combine: str) -> None:
        """Within 5 standard deviations of a sample mean and a sample covariance."""
        mu, sigma = combined([m for m, _ in laws()], [c for _, c in laws()])
        off, n = self.offsets(both[combine]), len(RUNS)
        assert (np.abs(off.mean(axis=1) - mu) < 5 * np.sqrt(np.diag(sigma) / n)).all()
        centred = off - mu[:, None]
        bound = 5 * np.sqrt((np.outer(np.diag(sigma), np.diag(sigma)) + sigma**2) / n)
        assert (np.abs(centred @ centred.T / n - sigma) < bound).all()

    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_what_it_says_of_itself(self, both: dict[str, Tracks], combine: str) -> None:
        _, sigma = combined([m for m, _ in laws()], [c for _, c in laws()])
        of = both[combine]
        for row in np.flatnonzero(of.row_object_ix == WALKER):
            for name, expected in (("cov_ee_m2", sigma[0, 0]), ("cov_en_m2", sigma[0, 1]), ("cov_nn_m2", sigma[1, 1])):
                np.testing.assert_allclose(getattr(of, name)[:, row], expected, rtol=1e-9)

    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_normal_in_every_direction(self, both: dict[str, Tracks], combine: str) -> None:
        z = whitened(self.offsets(both[combine]), *combined([m for m, _ in laws()], [c for _, c in laws()]))
        for angle in (0.0, 0.5, 1.0, 1.5, 2.0, 2.5):
            assert stats.kstest(math.cos(angle) * z[0] + math.sin(angle) * z[1], "norm").pvalue > 1e-3
        assert stats.kstest((z**2).sum(axis=0), "chi2", args=(2,)).pvalue > 1e-3

    def test_the_two_ways_have_one_law(self, both: dict[str, Tracks]) -> None:
        a, b = (self.offsets(of) for of in both.values())
        assert not np.allclose(a, b), "other draws"
        for angle in (0.0, 0.8, 1.6, 2.4):
            one, other = (math.cos(angle) * of[0] + math.sin(angle) * of[1] for of in (a, b))
            assert stats.ks_2samp(one, other).pvalue > 1e-3

    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_lists_and_runs_are_independent(self, both: dict[str, Tracks], combine: str) -> None:
        mu, sigma = combined([m for m, _ in laws()], [c for _, c in laws()])
        first, second = (whitened(self.offsets(both[combine], frame), mu, sigma) for frame in (0, 1))
        bound = 5 / math.sqrt(len(RUNS))
        assert np.abs(first @ second.T / len(RUNS)).max() < bound
        assert np.abs(first[:, 1:] @ first[:, :-1].T / len(RUNS)).max() < bound

    def test_it_is_the_law_of_those_that_saw(self) -> None:
        """Each unit lists with 0.6: per run μ and Σ of the units that did; believed in 1 − 0.4³ of the runs."""
        log, plan = watched(), three_units(0.6)
        found = observe_objects(log.scene, log.truth, plan)
        valid = perceive(log.scene, found, plan, RUNS, states="true").valid
        rows = [int(np.flatnonzero((found.tracks.row_object_ix == WALKER) & (found.tracks.row_unit_ix == u))[0])
                for u in range(3)]  # fmt: skip
        saw = valid[:, rows]
        for of in run_tracks(0.6, log).values():
            (row,) = np.flatnonzero(of.row_object_ix == WALKER)
            assert np.array_equal(of.valid[:, row], saw.any(axis=1))
            assert stats.binomtest(int(of.valid[:, row].sum()), len(RUNS), 1 - 0.4**3).pvalue > 1e-6
            offsets = np.stack([of.x_m[:, row] - 20.0, of.y_m[:, row] - 5.0])
            pieces = []
            for who in range(1, 8):
                units = [u for u in range(3) if who >> u & 1]
                mine = (saw == [u in units for u in range(3)]).all(axis=1)
                mu, sigma = combined([laws()[u][0] for u in units], [laws()[u][1] for u in units])
                np.testing.assert_allclose(of.cov_en_m2[mine, row], sigma[0, 1], rtol=1e-9)  # type: ignore[index]
                pieces.append(whitened(offsets[:, mine], mu, sigma))
                for component in pieces[-1]:
                    assert stats.kstest(component, "norm").pvalue > 1e-4
            z = np.concatenate(pieces, axis=1)
            assert abs(np.corrcoef(z)[0, 1]) < 5 / math.sqrt(z.shape[1])

    def test_nothing_under_what_nobody_saw(self) -> None:
        for of in run_tracks(0.2, watched()).values():
            for name in (*VALUES, "cov_ee_m2", "cov_en_m2", "cov_nn_m2"):
                column = np.broadcast_to(getattr(of, name), of.valid.shape)
                assert np.isfinite(column[of.valid]).all()
            assert not of.valid.all()

    def test_the_receivers_own_body_is_left_out(self) -> None:
        """The van and the mast see the ego; it does not list itself."""
        log = watched()
        assert 0 in run_tracks(1.0, log)["samples"].object_ix
        without = run_tracks(1.0, log, without=0)["samples"]
        assert sorted(without.object_ix) == [1, 2]


class TestStaleLists:
    def test_two_latencies(self) -> None:
        """A car drives 10 m/s along x. One unit is immediate (1 m²), one takes 0.3 s (3 m²).

        At 1 s they say 10 m and 7 m: ¾ · 10 + ¼ · 7 = 9.25 m, and nothing is predicted.
        """
        listing = {
            name: [(k / 10, {1: gauss(k, 0, [[c, 0], [0, c]])}) for k in range(21)] for name, c in (("a", 1), ("b", 3))
        }
        found = issued(received(listing, {"b": 0.3}))
        at = {round(one["at"], 6): one for one in found}
        assert place(at[1.0]["holds"][1]) == pytest.approx((9.25, 0))
        assert at[1.0]["captured"] == pytest.approx(1.0)
        np.testing.assert_allclose(covariance(at[1.0]["holds"][1]), [[0.75, 0], [0, 0.75]])
        assert place(at[0.2]["holds"][1]) == pytest.approx((2, 0)), "the late one has not arrived yet"
        assert place(at[0.3]["holds"][1]) == pytest.approx((0.75 * 3, 0)), "it has, with what it saw at 0 s"
        # After the end the immediate one's last list, of 2 s, stays while the late one's still come.
        assert place(at[2.3]["holds"][1]) == pytest.approx((20, 0))
        assert place(at[2.2]["holds"][1]) == pytest.approx((0.75 * 20 + 0.25 * 19, 0))
        assert max(at) == pytest.approx(2.3)

    def test_no_list_before_the_latency(self) -> None:
        listing = {"a": [(k / 10, {0: gauss(0, 0, SMALL)}) for k in range(5)]}
        found = issued(received(listing, {"a": 0.35}))
        assert [one["at"] for one in found] == pytest.approx([0.35, 0.45, 0.55, 0.65, 0.75])
        assert [one["captured"] for one in found] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
        assert [one["stamp"] for one in found] == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]

    def test_an_empty_list_is_a_list(self) -> None:
        found = issued(received({"a": [(0.0, {}), (0.1, {0: gauss(1, 1, SMALL)}), (0.2, {})]}))
        assert [sorted(one["holds"]) for one in found] == [[], [0], []]

    def test_an_object_that_one_unit_lists(self) -> None:
        """It is believed as that unit says, to the last digit; and gone from the next list that does not hold it."""
        says = gauss(0.1 + 0.2, 1 / 3, [[0.7, 0.1], [0.1, 0.4]], vx_mps=0.3, yaw_rad=1.0)
        found = issued(received({
            "a": [(0.0, {0: says}), (0.2, {}), (0.4, {})],
            "b": [(0.0, {}), (0.1, {1: gauss(9, 9, SMALL)}), (0.2, {1: gauss(9, 9, SMALL)})],
        }))  # fmt: skip
        assert [sorted(one["holds"]) for one in found] == [[0], [0, 1], [1], [1]]
        assert place(found[0]["holds"][0]) == place(says)
        np.testing.assert_allclose(covariance(found[0]["holds"][0]), [[0.7, 0.1], [0.1, 0.4]], rtol=1e-12)

    def test_runs_in_which_it_was_not_listed(self) -> None:
        listing = {
            "a": [(0.0, {0: gauss(0, 0, SMALL, valid=[True, True, False, False])})],
            "b": [(0.0, {0: gauss(4, 0, SMALL, valid=[True, False, True, False])})],
        }
        fused = fuse_ideal(received(listing, runs=4), max_age_s=1.0).fused
        assert fused.valid[:, 0].tolist() == [True, True, True, False]
        assert fused.x_m[:3, 0].tolist() == [2, 0, 4]
        assert fused.cov_ee_m2 is not None
        assert fused.cov_ee_m2[:3, 0].tolist() == [0.5, 1, 1]

    @pytest.mark.parametrize(("latency_s", "last_s"), [(0.0, 0.3), (0.2, 0.5)])
    def test_lists_grow_too_old(self, latency_s: float, last_s: float) -> None:
        """One list alone, 0.3 s of age allowed from capture, on top of its own way; the other unit's go on."""
        listing: dict[str, ObjectLists] = {
            "once": [(0.0, {0: gauss(1, 1, SMALL)})],
            "on": [(k / 10, {1: gauss(9, 9, SMALL)}) for k in range(9)],
        }
        found = issued(received(listing, {"once": latency_s}), max_age_s=0.3)
        holding = [one["at"] for one in found if 0 in one["holds"]]
        assert (min(holding), max(holding)) == pytest.approx((latency_s, last_s))
        assert all(1 in one["holds"] for one in found)

    def test_arrivals_within_a_microsecond_are_one_instant(self) -> None:
        listing = {
            "a": [(0.0, {0: gauss(0, 0, SMALL)}), (0.1, {0: gauss(0, 0, SMALL)})],
            "b": [(0.0, {0: gauss(2, 0, SMALL)}), (0.1, {0: gauss(2, 0, SMALL)})],
        }
        near = issued(received(listing, {"b": 0.7e-6}))
        assert [one["at"] for one in near] == pytest.approx([0.0, 0.1], abs=1.1e-6)
        assert [place(one["holds"][0]) for one in near] == [(1, 0), (1, 0)]
        apart = issued(received(listing, {"b": 3e-6}))
        assert [one["at"] for one in apart] == pytest.approx([0.0, 3e-6, 0.1, 0.1 + 3e-6], abs=1e-9)
        assert [place(one["holds"][0])[0] for one in apart] == [0, 1, 1, 1]

    def test_coincident_arrivals_of_other_captures(self) -> None:
        """0.1 + 0.2 and 0.3 + 0 are not the same float, and yet one instant."""
        listing = {
            "a": [(k / 10, {0: gauss(0, 0, SMALL)}) for k in range(6)],
            "b": [(k / 10, {0: gauss(2, 0, SMALL)}) for k in range(6)],
        }
        found = issued(received(listing, {"a": 0.2}))
        assert [one["at"] for one in found] == pytest.approx([k / 10 for k in range(8)])

    def test_lost_lists_never_arrive(self) -> None:
        """`arrives_s` is infinite for the list of 0.1 s: at 0.1 s nothing is issued, at 0.2 s all is as ever."""
        of = received({"a": [(k / 10, {0: gauss(k, 0, SMALL)}) for k in range(4)]})
        lost = replace(of, arrives_s=np.array([[0.0, np.inf, 0.2, 0.3]]))
        found = issued(lost)
        assert [(one["at"], place(one["holds"][0])[0]) for one in found] == [(0.0, 0), (0.2, 2), (0.3, 3)]
        all_but_one = issued(replace(of, arrives_s=np.array([[np.inf, np.inf, np.inf, 0.3]])))
        assert [(one["at"], place(one["holds"][0])[0]) for one in all_but_one] == [(0.3, 3)]

    def test_nothing_heard_at_all(self) -> None:
        assert issued(received({"a": [], "b": []})) == []
        assert issued(received({"a": []})) == []
        assert fusion_schedule(received({"a": []}), max_age_s=1.0).issue_s.tolist() == []


TICK = 10
"""Milliseconds: captures, latencies and ages are multiples, so that instants coincide often, and else are far apart."""
ticks = st.integers(0, 12).map(lambda k: k * TICK)


@st.composite
def said(draw: st.DrawFn) -> Says:
    a = np.array(draw(st.lists(st.floats(-2, 2), min_size=4, max_size=4))).reshape(2, 2)
    c = a @ a.T + 0.01 * np.eye(2)
    small = st.floats(-5, 5)
    variance = st.sampled_from([1e-4, 0.1, 2.0])
    return gauss(
        draw(small), draw(small), c,
        valid=draw(st.lists(st.booleans(), min_size=2, max_size=2)),
        z_m=draw(small), vx_mps=draw(small), length_m=draw(st.floats(0.1, 5)), yaw_rad=draw(st.floats(-3.2, 3.2)),
        yaw_var_rad2=draw(variance), size_var_m2=draw(variance), speed_var_m2ps2=draw(variance),
    )  # fmt: skip


@st.composite
def units_lists(draw: st.DrawFn) -> tuple[dict[str, list[tuple[int, dict[int, Says]]]], dict[str, int]]:
    units = {}
    for name in draw(st.sampled_from([("a",), ("a", "b"), ("c", "a", "b")])):
        captures = sorted(draw(st.lists(ticks, unique=True, max_size=4)))
        units[name] = [(t, draw(st.dictionaries(st.integers(0, 2), said(), max_size=3))) for t in captures]
    return units, {name: draw(ticks) for name in units}


def weighed(pairs: list[tuple[float, float]]) -> float:
    """Mean by weights one over variance."""
    return sum(value / variance for value, variance in pairs) / sum(1 / variance for _, variance in pairs)


@given(units_lists(), st.sampled_from([TICK, 3 * TICK, 100 * TICK]), st.sampled_from([-1, 0, 2]))
def test_against_the_words(
    world: tuple[dict[str, list[tuple[int, dict[int, Says]]]], dict[str, int]], max_age: int, own: int
) -> None:
    """A list at every instant at which one arrives; each unit's newest that has arrived and is not too old."""
    units, latency = world
    in_seconds: dict[str, ObjectLists] = {u: [(t / 1000, held) for t, held in its] for u, its in units.items()}
    of = received(in_seconds, {u: late / 1000 for u, late in latency.items()}, runs=2)
    fused = fuse_ideal(of, max_age_s=max_age / 1000, without_object_ix=own).fused
    instants = sorted({t + latency[u] for u, its in units.items() for t, _ in its})
    assert fused.arrives_s[0] == pytest.approx([t / 1000 for t in instants])
    rows = {(int(f), int(o)): p for p, (f, o) in enumerate(zip(fused.frame_ix, fused.row_object_ix, strict=True))}
    assert len(rows) == len(fused.frame_ix)
    for k, now in enumerate(instants):
        used = []
        for u, its in units.items():
            arrived = [(t, held) for t, held in its if t + latency[u] <= now]
            if arrived and now - arrived[-1][0] <= max_age + latency[u]:
                used.append(arrived[-1])
        assert fused.captured_s[k] == pytest.approx(max(t for t, _ in used) / 1000)
        assert fused.stamp_ns[k] == max(t for t, _ in used) * 1_000_000
        for run in range(2):
            for o in range(3):
                entries = [held[o] for _, held in used if o in held and held[o]["valid"][run] and o != own]
                p = rows.get((k, o))
                assert bool(entries) == (p is not None and bool(fused.valid[run, p]))
                if not entries or p is None:
                    continue
                mu, sigma = combined([place(e) for e in entries], [covariance(e) for e in entries])
                assert [fused.x_m[run, p], fused.y_m[run, p]] == pytest.approx(mu, abs=1e-6)
                claimed = [getattr(fused, name)[run, p] for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2")]
                assert claimed == pytest.approx([sigma[0, 0], sigma[0, 1], sigma[1, 1]], rel=1e-6, abs=1e-9)
                assert fused.z_m[run, p] == pytest.approx(np.mean([e["z_m"] for e in entries]))
                length = weighed([(e["length_m"], e["size_var_m2"]) for e in entries])
                speed = weighed([(e["vx_mps"], e["speed_var_m2ps2"]) for e in entries])
                assert [fused.length_m[run, p], fused.vx_mps[run, p]] == pytest.approx([length, speed], abs=1e-9)
                east = weighed([(math.cos(e["yaw_rad"]), e["yaw_var_rad2"]) for e in entries])
                north = weighed([(math.sin(e["yaw_rad"]), e["yaw_var_rad2"]) for e in entries])
                turned = fused.yaw_rad[run, p]
                if math.hypot(east, north) > 1e-3:  # else they point in opposite directions
                    assert math.cos(turned) == pytest.approx(east / math.hypot(east, north), abs=1e-9)
                    assert math.sin(turned) == pytest.approx(north / math.hypot(east, north), abs=1e-9)


def test_neither_the_receivers_own_body_nor_what_has_no_truth_id_is_in_the_list() -> None:
    """Object 2 carries the receiver; −1: an entry of a recorded unit about nobody known."""
    of = received({"a": [(0.0, {-1: {}, 1: {}, 2: {}})], "b": [(0.0, {-1: {}, 2: {}, 3: {}})]})
    (everything,) = issued(of)
    assert sorted(everything["holds"]) == [1, 2, 3]
    (others,) = issued(of, without_object_ix=2)
    assert sorted(others["holds"]) == [1, 3]
