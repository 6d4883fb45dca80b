"""Conditions, detection models and error models: by hand, and error laws by what a matrix must do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy import stats

from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import CLASSES
from copem_replay.core.view_geometry import Errors, Noise, ViewGeometry
from copem_replay.perception.pem.condition import Condition, Couple, find_couples
from copem_replay.perception.pem.detection import DetectionModel
from copem_replay.perception.pem.error import ErrorModel, Gaussian, StudentT

Array = npt.NDArray[np.float64]


def view(
    range_m: Sequence[float] = (10.0,),
    *,
    azimuth_deg: float | Sequence[float] = 0.0,
    bearing_deg: float | Sequence[float] = 0.0,
    visible_share: float | Sequence[float] = 1.0,
    kinds: str | Sequence[str] = "car",
) -> ViewGeometry:
    """How rows look; a single value is every row's."""
    n = max(len(v) for v in (range_m, azimuth_deg, bearing_deg, visible_share) if not isinstance(v, float | int))
    n = max(n, 1 if isinstance(kinds, str) else len(kinds))

    def column(values: float | Sequence[float]) -> Array:
        return np.broadcast_to(np.asarray(values, dtype=float), (n,)).copy()

    names = [kinds] * n if isinstance(kinds, str) else list(kinds)
    return ViewGeometry(
        range_m=column(range_m),
        azimuth_rad=np.deg2rad(column(azimuth_deg)),
        bearing_rad=np.deg2rad(column(bearing_deg)),
        visible_share=column(visible_share),
        class_ix=np.array([CLASSES.index(name) for name in names], dtype=np.int8),
        length_m=column(4.0),
        width_m=column(2.0),
        height_m=column(1.5),
        yaw_rad=column(0.0),
        speed_mps=column(0.0),
    )


def holds(seen: ViewGeometry, **when: Any) -> list[bool]:
    return Condition.model_validate(when).holds(seen).tolist()


class TestConditions:
    def test_nothing_said_holds_always(self) -> None:
        assert holds(view([0, 1e6], visible_share=0, kinds="other", azimuth_deg=179)) == [True, True]

    def test_range_bounds_are_included(self) -> None:
        seen = view([0, 9.999, 10, 10.001, 20, 59.999, 60, 60.001])
        assert holds(seen, range_m=[10, 60]) == [False, False, True, True, True, True, True, False]
        assert holds(seen, range_m=[0, 0]) == [True] + [False] * 7

    def test_visible_share_bounds_are_included(self) -> None:
        seen = view(visible_share=[0, 0.25, 0.3, 0.75, 0.8, 1])
        assert holds(seen, visible_share=[0.25, 0.75]) == [False, True, True, True, False, False]
        assert holds(seen, visible_share=[0, 1]) == [True] * 6

    @pytest.mark.parametrize(
        ("azimuth_deg", "within", "without"),
        [
            ([-30, 30], [-30, -29, 0, 30], [-30.1, 30.1, 90, 180, -90]),
            ([150, -150], [150, 151, 179, 180, -180, -179, -150], [149.9, -149.9, 0, 90, -90]),
            ([90, 90], [90], [89.9, 90.1, -90]),
            ([-180, 180], [-180, -90, 0, 179, 180], []),
            ([0, 360], [-180, -90, 0, 179, 180], []),
            ([350, 10], [-10, 0, 10], [-11, 11, 180]),
            ([-200, -160], [160, 180, -180, -160], [159, -159, 0]),
            ([179, -179], [179, 180, -180, -179], [178.9, -178.9, 0]),
            ([10, -10], [10, 90, 180, -90, -10], [9.9, 0, -9.9]),
        ],
    )
    def test_azimuth(self, azimuth_deg: list[float], within: list[float], without: list[float]) -> None:
        found = holds(view(azimuth_deg=[*within, *without]), azimuth_deg=azimuth_deg)
        assert found == [True] * len(within) + [False] * len(without)

    def test_classes_and_groups(self) -> None:
        seen = view(kinds=["pedestrian", "bicycle", "motorcycle", "car", "animal", "vehicle"])
        assert holds(seen, classes=["car", "animal"]) == [False, False, False, True, True, False]
        assert holds(seen, classes=["vru"]) == [True, True, True, False, False, False]
        assert holds(seen, classes=["vehicles"]) == [False, False, True, True, False, True]
        assert holds(seen, classes=["vru", "car"]) == [True, True, True, True, False, False]

    def test_all_that_is_given_must_hold(self) -> None:
        seen = view([5, 50, 5, 5, 5], azimuth_deg=[0, 0, 90, 0, 0], visible_share=[1, 1, 1, 0.1, 1],
                    kinds=["car", "car", "car", "car", "bus"])  # fmt: skip
        when = {"range_m": [0, 10], "azimuth_deg": [-45, 45], "visible_share": [0.5, 1], "classes": ["car"]}
        assert holds(seen, **when) == [True, False, False, False, False]

    @pytest.mark.parametrize(
        "when",
        [
            {"range_m": [60, 10]}, {"range_m": [-1, 10]}, {"range_m": [0]}, {"range_m": [0, math.inf]},
            {"range_m": ["0", "10"]}, {"visible_share": [0.5, 0.1]}, {"visible_share": [0, 1.1]},
            {"classes": ["pedestrain"]}, {"classes": []}, {"azimuth_deg": [0]}, {"azimuth_deg": [math.nan, 0]},
            {"range": [0, 10]},
        ],
    )  # fmt: skip
    def test_what_is_refused(self, when: dict[str, Any]) -> None:
        with pytest.raises(ValidationError):
            Condition.model_validate(when)


def couples(*data: dict[str, Any]) -> tuple[Couple, ...]:
    sure = {"detection": {"kind": "constant", "probability": 1.0}}
    return tuple(Couple.model_validate(sure | each) for each in data)


class TestTheFirstThatHolds:
    def test_it_applies(self) -> None:
        pem = couples(
            {"when": {"range_m": [0, 20]}},
            {"when": {"range_m": [10, 50], "classes": ["vru"]}},
            {"when": {"range_m": [10, 40]}},
        )
        seen = view([5, 20, 20.5, 30, 45, 45, 60], kinds=["car", "car", "bicycle", "car", "bicycle", "car", "bicycle"])
        assert find_couples(pem, seen).tolist() == [0, 0, 1, 2, 1, -1, -1]

    def test_order_decides(self) -> None:
        near, any_ = {"when": {"range_m": [0, 20]}}, {}
        assert find_couples(couples(near, any_), view([10, 30])).tolist() == [0, 1]
        assert find_couples(couples(any_, near), view([10, 30])).tolist() == [0, 0]


def probability(data: dict[str, Any], seen: ViewGeometry) -> list[float]:
    (couple,) = couples({"detection": data})
    return couple.detection.probability(seen).tolist()


class TestDetectionModels:
    def test_visible_share(self) -> None:
        assert probability({"kind": "visible_share"}, view([1, 2, 3], visible_share=[0, 0.37, 1])) == [0, 0.37, 1]

    def test_constant(self) -> None:
        seen = view([1, 99], visible_share=[0, 1])
        assert probability({"kind": "constant", "probability": 0.9}, seen) == [0.9, 0.9]

    def test_table_between_its_values_and_beyond_them(self) -> None:
        """A quarter of the way in range and half way in share: .75 (.5·0 + .5·.4) + .25 (.5·.8 + .5·1) = .375."""
        table = {
            "kind": "table",
            "range_m": [10, 30, 50],
            "visible_share": [0.2, 0.6],
            "probability": [[0.0, 0.4], [0.8, 1.0], [0.1, 0.3]],
        }
        cases = {
            (10, 0.2): 0.0, (10, 0.6): 0.4, (30, 0.2): 0.8, (30, 0.6): 1.0, (50, 0.2): 0.1, (50, 0.6): 0.3,  # corners
            (15, 0.4): 0.375,
            (20, 0.2): 0.4, (40, 0.6): 0.65, (30, 0.3): 0.85,  # on the edges
            (0, 0.4): 0.2, (200, 0.4): 0.2, (20, 0.0): 0.4, (20, 1.0): 0.7, (0, 0): 0.0, (99, 1): 0.3,  # beyond
        }  # fmt: skip
        ranges, shares = zip(*cases, strict=True)
        assert probability(table, view(ranges, visible_share=shares)) == pytest.approx(list(cases.values()))

    def test_table_by_range_alone(self) -> None:
        table = {"kind": "table", "range_m": [0, 50, 100], "probability": [[1.0], [0.5], [0.0]]}
        seen = view([0, 25, 50, 80, 100, 150], visible_share=[0, 1, 0.3, 0.9, 0.5, 0.1])
        assert probability(table, seen) == pytest.approx([1, 0.75, 0.5, 0.2, 0, 0])

    def test_table_by_share_alone(self) -> None:
        table = {"kind": "table", "visible_share": [0.1, 0.5], "probability": [[0.0, 1.0]]}
        seen = view([0, 25, 50, 80], visible_share=[0, 0.2, 0.5, 1])
        assert probability(table, seen) == pytest.approx([0, 0.25, 1, 1])

    def test_table_of_one_value(self) -> None:
        assert probability({"kind": "table", "probability": [[0.3]]}, view([0, 99])) == [0.3, 0.3]

    @pytest.mark.parametrize(
        "data",
        [
            {"kind": "constant"}, {"kind": "constant", "probability": 1.01}, {"kind": "constant", "probability": True},
            {"kind": "constant", "probability": -0.1}, {"kind": "visible_share", "probability": 1.0},
            {"kind": "table", "range_m": [0, 10], "probability": [[1.0]]},
            {"kind": "table", "range_m": [0, 10], "probability": [[1.0, 0.5]]},
            {"kind": "table", "range_m": [10, 0], "probability": [[1.0], [0.5]]},
            {"kind": "table", "range_m": [0, 0], "probability": [[1.0], [0.5]]},
            {"kind": "table", "range_m": [0, 1], "visible_share": [0, 1], "probability": [[1, 1], [1]]},
            {"kind": "table", "range_m": [], "probability": []},
            {"kind": "nothing_like_it"}, {"probability": 1.0}, "constant",
        ],
    )  # fmt: skip
    def test_what_is_refused(self, data: Any) -> None:
        with pytest.raises(ValidationError):
            couples({"detection": data})


class Basis:
    """Noise that hands each name its own direction, to read off how an error model scales what it is handed."""

    def __init__(self, rows: int) -> None:
        self.names: list[str] = []
        self.rows = rows
        self.raised: str | None = None

    def __call__(self, name: str) -> Array:
        if name not in self.names:
            self.names.append(name)
        return np.full((1, self.rows), 1.0 if name == self.raised else 0.0)


def response(model: ErrorModel, seen: ViewGeometry) -> tuple[Errors, dict[str, Array]]:
    """Errors without noise, and for each name by how much a noise of 1 moves east and north: (P, 2)."""
    noise = Basis(len(seen.range_m))
    still = model.perturb(seen, noise)
    moved = {}
    for name in list(noise.names):
        noise.raised = name
        errors = model.perturb(seen, noise)
        moved[name] = np.stack([errors.east_m - still.east_m, errors.north_m - still.north_m], axis=-1)[0]
    return still, moved


def gaussian(covariance_m2: Any, **more: Any) -> Gaussian:
    return Gaussian.model_validate({"covariance_m2": covariance_m2} | more)


COVARIANCES = {
    "round": [[1.0, 0.0], [0.0, 1.0]],
    "long": [[4.0, 0.0], [0.0, 0.25]],
    "slanted": [[2.0, -1.2], [-1.2, 1.5]],
    "a line": [[1.0, 1.0], [1.0, 1.0]],
    "a line falling": [[4.0, -2.0], [-2.0, 1.0]],
    "north only": [[0.0, 0.0], [0.0, 2.0]],
    "none": [[0.0, 0.0], [0.0, 0.0]],
}


def turned(vector_or_matrix: Any, degrees: float) -> Array:
    """From along and across a line of sight at `degrees` from east into easting and northing."""
    a = math.radians(degrees)
    along, left = np.array([math.cos(a), math.sin(a)]), np.array([-math.sin(a), math.cos(a)])
    axes = np.stack([along, left], axis=1)
    given = np.array(vector_or_matrix, dtype=float)
    result: Array = axes @ given if given.ndim == 1 else axes @ given @ axes.T
    return result


def test_students_t_by_its_law() -> None:
    """Each axis over √(variance · ⅓) is t₃, whose 2.5 % quantile is 3.182; both axes share the factor."""
    rng = np.random.default_rng(0)
    normals = {name: rng.normal(size=(200_000, 1)) for name in ("position 1", "position 2", "tails")}
    keys = {"covariance_m2": [[0.3, 0.0], [0.0, 0.03]], "degrees_of_freedom": 3.0}
    found = StudentT.model_validate(keys).perturb(view([10.0]), normals.__getitem__)
    for error_m, variance_m2 in ((found.east_m, 0.3), (found.north_m, 0.03)):
        scaled = np.abs(error_m) / math.sqrt(variance_m2 / 3)
        for level in (0.5, 0.05, 0.01):
            assert (scaled > stats.t.ppf(1 - level / 2, 3)).mean() == pytest.approx(level, rel=0.06)
    far = np.abs(found.east_m) > 4 * math.sqrt(0.1)
    assert (np.abs(found.north_m) > 2 * math.sqrt(0.01))[far].mean() > 0.4  # of independent axes .14
    assert [found.cov_ee_m2[0], found.cov_nn_m2[0]] == [0.3, 0.03]
    with pytest.raises(ValidationError):
        StudentT.model_validate(keys | {"degrees_of_freedom": 2.0})


class TestGaussian:
    @pytest.mark.parametrize("bearing_deg", [0.0, 30.0, 90.0, 137.0, 180.0, -101.0])
    @pytest.mark.parametrize("name", COVARIANCES)
    @pytest.mark.parametrize("frame", ["absolute", "line_of_sight"])
    def test_offsets_have_the_covariance_they_claim(
        self, name: str, frame: Literal["absolute", "line_of_sight"], bearing_deg: float
    ) -> None:
        mean = [0.7, -0.2]
        model = gaussian(COVARIANCES[name], mean_m=mean, frame=frame)
        degrees = bearing_deg if frame == "line_of_sight" else 0.0
        still, moved = response(model, view([10.0, 99.0], bearing_deg=bearing_deg))
        expected = turned(COVARIANCES[name], degrees)
        for row in range(2):
            assert [still.east_m[0, row], still.north_m[0, row]] == pytest.approx(turned(mean, degrees))
            law = sum(np.outer(by[row], by[row]) for by in moved.values())
            np.testing.assert_allclose(law, expected, atol=1e-12)
            claimed = [[still.cov_ee_m2[row], still.cov_en_m2[row]], [still.cov_en_m2[row], still.cov_nn_m2[row]]]
            np.testing.assert_allclose(claimed, expected, atol=1e-12)

    def test_along_the_line_of_sight_by_hand(self) -> None:
        """An object due north: 3 m further along is 3 m north, 1 m to the left of the line is 1 m west."""
        model = gaussian([[9.0, 0.0], [0.0, 0.01]], mean_m=[3.0, 1.0], frame="line_of_sight")
        still, _ = response(model, view(bearing_deg=[90.0]))
        assert [still.east_m[0, 0], still.north_m[0, 0]] == pytest.approx([-1.0, 3.0])
        assert [still.cov_ee_m2[0], still.cov_nn_m2[0], still.cov_en_m2[0]] == pytest.approx([0.01, 9.0, 0.0])

    @settings(deadline=None)
    @given(
        st.lists(st.floats(-5, 5).filter(lambda v: v == 0 or abs(v) > 1e-3), min_size=4, max_size=4),
        st.floats(-180, 180),
    )
    def test_any_matrix_that_is_a_covariance(self, factor: list[float], bearing_deg: float) -> None:
        """A product of a matrix with its transpose is one."""
        a = np.array(factor).reshape(2, 2)
        covariance = a @ a.T
        still, moved = response(gaussian(covariance.tolist(), frame="line_of_sight"), view(bearing_deg=[bearing_deg]))
        law = sum(np.outer(by[0], by[0]) for by in moved.values())
        expected, scale = turned(covariance, bearing_deg), 1e-12 + np.abs(covariance).max()
        np.testing.assert_allclose(law, expected, atol=1e-8 * scale)
        claimed = [still.cov_ee_m2[0], still.cov_en_m2[0], still.cov_nn_m2[0]]
        np.testing.assert_allclose(claimed, [expected[0, 0], expected[0, 1], expected[1, 1]], atol=1e-12 * scale)

    @pytest.mark.parametrize("name", COVARIANCES)
    @pytest.mark.parametrize("frame", ["absolute", "line_of_sight"])
    def test_many_addressed_draws(self, name: str, frame: Literal["absolute", "line_of_sight"]) -> None:
        """Mean and covariance of n = 30 000 draws, each within 5 of its standard deviations.

        Those of the sample mean are √(Cᵢᵢ / n), those of the sample covariance √((Cᵢᵢ Cⱼⱼ + Cᵢⱼ²) / n).
        """
        n, mean, bearing_deg = 30_000, [0.3, -0.8], 130.0
        rng, at = (
            CounterRng(5, "log"),
            RandomKey(("u",), np.zeros(1, dtype=int), object_words(["7"]), np.array([10**18])),
        )

        def noise(name: str) -> Array:
            return rng.normal(name, at, np.arange(n))

        errors = gaussian(COVARIANCES[name], mean_m=mean, frame=frame).perturb(view(bearing_deg=[bearing_deg]), noise)
        degrees = bearing_deg if frame == "line_of_sight" else 0.0
        C, centre = turned(COVARIANCES[name], degrees), turned(mean, degrees)
        offsets = np.stack([errors.east_m[:, 0], errors.north_m[:, 0]])
        assert np.all(np.abs(offsets.mean(axis=1) - centre) <= 5 * np.sqrt(np.diag(C) / n) + 1e-12)
        centred = offsets - centre[:, None]
        bound = 5 * np.sqrt((np.outer(np.diag(C), np.diag(C)) + C**2) / n)
        assert np.all(np.abs(centred @ centred.T / n - C) <= bound + 1e-12)
        # In the directions in which a singular covariance has no width there is no error at all.
        width, axes = np.linalg.eigh(C)
        across = axes.T @ centred
        assert np.abs(across[width < 1e-12]).max(initial=0) < 1e-7
        for k in np.flatnonzero(width > 1e-12):
            assert stats.kstest(across[k] / math.sqrt(width[k]), "norm").pvalue > 1e-3

    def test_what_is_not_asked_for_is_exact(self) -> None:
        errors, moved = response(gaussian([[1, 0], [0, 1]]), view())
        assert len(moved) == 2
        assert (errors.yaw_rad, errors.yaw_var_rad2) == (None, None)
        assert (errors.size_m, errors.size_var_m2) == (None, None)
        assert (errors.speed_mps, errors.speed_var_m2ps2) == (None, None)

    def test_yaw_size_and_speed(self) -> None:
        """Standard deviations 18°, 0.2 m, 3 m/s; six errors in all that share no draw with each other."""
        model = gaussian([[1, 0], [0, 1]], yaw_sigma_deg=18.0, size_sigma_m=0.2, speed_sigma_mps=3.0)
        seen = view([10.0, 20.0])
        noise = Basis(2)
        still = model.perturb(seen, noise)
        assert len(noise.names) == 7

        def others(errors: Errors) -> Array:
            assert errors.yaw_rad is not None and errors.size_m is not None  # noqa: PT018
            assert errors.speed_mps is not None
            assert errors.size_m.shape == (3, 1, 2)
            return np.stack([errors.yaw_rad[0], *errors.size_m[:, 0], errors.speed_mps[0]])[:, 0]

        assert not others(still).any()
        moved = []
        for name in list(noise.names):
            noise.raised = name
            moved.append(others(model.perturb(seen, noise)))
        scale = np.array([math.pi / 10, 0.2, 0.2, 0.2, 3.0])
        by_size = sorted((row.tolist() for row in moved if row.any()), reverse=True)
        np.testing.assert_allclose(by_size, np.diag(scale), atol=1e-15)
        np.testing.assert_allclose(still.yaw_var_rad2, [math.pi**2 / 100] * 2)
        np.testing.assert_allclose(still.size_var_m2, [0.04] * 2)
        np.testing.assert_allclose(still.speed_var_m2ps2, [9.0] * 2)

    @pytest.mark.parametrize(
        "covariance_m2",
        [
            [[1.0, 0.5], [0.4, 1.0]],  # not symmetric
            [[1.0, 0.5], [-0.5, 1.0]],
            [[0.0, 1e-3], [0.0, 0.0]],
            [[1.0, 1.1], [1.1, 1.0]],  # correlation above 1
            [[1.0, -2.0], [-2.0, 1.0]],
            [[-1.0, 0.0], [0.0, 1.0]],
            [[1.0, 0.0], [0.0, -1e-6]],
            [[0.0, 0.5], [0.5, 1.0]],  # tied to what does not vary
            [[1.0]],
            [[1.0, 0.0]],
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[math.nan, 0.0], [0.0, 1.0]],
            [[math.inf, 0.0], [0.0, 1.0]],
            [["1", "0"], ["0", "1"]],
            1.0,
        ],
    )
    def test_what_is_no_covariance(self, covariance_m2: Any) -> None:
        with pytest.raises(ValidationError):
            gaussian(covariance_m2)

    def test_rounding_of_the_last_digit_is_not_refused(self) -> None:
        a, b = math.sqrt(2), math.sqrt(3)
        gaussian([[a * a, a * b], [b * a, b * b]])
        gaussian([[0.1 + 0.2, 0.3], [0.3, 0.3]])
        gaussian([[1.0, 1e-9], [0.0, 1.0]])
        with pytest.raises(ValidationError, match="symmetric"):
            gaussian([[1.0, 1.1e-9], [0.0, 1.0]])

    @pytest.mark.parametrize(
        "covariance_m2",
        [
            [[1e-20, 1e-5], [1e-5, 1.0]],
            [[1.0, 1e-5], [1e-5, 1e-20]],
            [[0.0, 1e-5], [1e-5, 1.0]],
            [[1e-15, -3e-8], [-3e-8, 1.0]],
        ],
    )
    def test_what_rounding_left_of_a_singular_one_is_not_blown_up(self, covariance_m2: list[list[float]]) -> None:
        _, moved = response(gaussian(covariance_m2), view())
        law = sum(np.outer(by[0], by[0]) for by in moved.values())
        np.testing.assert_allclose(law, covariance_m2, atol=2e-5)

    @pytest.mark.parametrize(
        "more",
        [{"yaw_sigma_deg": -1.0}, {"size_sigma_m": -1.0}, {"mean_m": [1.0]}, {"frame": "polar"}, {"sigma": 1.0}],
    )
    def test_what_else_is_refused(self, more: dict[str, Any]) -> None:
        with pytest.raises(ValidationError):
            gaussian([[1.0, 0.0], [0.0, 1.0]], **more)


class Fading(DetectionModel):
    """A user's own: half the visible share."""

    times: float

    def probability(self, view: ViewGeometry) -> Array:
        return self.times * view.visible_share


class Eastward(ErrorModel):
    """A user's own: always one metre too far east."""

    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        zeros = np.zeros(len(view.range_m))
        return Errors(noise("mine") * 0 + 1.0, noise("mine") * 0, zeros, zeros, zeros)


class NotOne:
    """Not a component."""


class TestUsersOwn:
    def test_by_dotted_path(self) -> None:
        couple = Couple.model_validate(
            {
                "detection": {"kind": f"{__name__}:Fading", "times": 0.5},
                "error": {"kind": f"{__name__}:Eastward"},
            }
        )
        assert type(couple.detection) is Fading
        assert couple.detection.probability(view(visible_share=[0.2, 1.0])).tolist() == [0.1, 0.5]
        assert couple.error is not None
        assert couple.error.perturb(view([1, 2]), Basis(2)).east_m.tolist() == [[1.0, 1.0]]

    def test_it_survives_being_written_down(self) -> None:
        couple = Couple.model_validate({"detection": {"kind": f"{__name__}:Fading", "times": 0.5}})
        assert Couple.model_validate(couple.model_dump(mode="json", by_alias=True)) == couple

    @pytest.mark.parametrize(
        "data",
        [
            {"kind": f"{__name__}:Fading"},  # its own keys are checked like ours
            {"kind": f"{__name__}:Fading", "times": 0.5, "more": 1},
            {"kind": f"{__name__}:Missing"},
            {"kind": f"{__name__}:NotOne"},
            {"kind": "no_such_module:Fading"},
            {"kind": f"{__name__}:"},
            {"kind": ":Fading"},
            {"kind": f"{__name__}.Fading"},
        ],
    )
    def test_what_is_refused(self, data: dict[str, Any]) -> None:
        with pytest.raises(ValidationError):
            Couple.model_validate({"detection": data})
