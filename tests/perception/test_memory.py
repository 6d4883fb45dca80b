"""Memory of a PEM: marginals stay, correlation is as declared, everything else is untouched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from copem_replay.core.random import stable_hash
from copem_replay.core.tracks import Float, Int, Tracks
from copem_replay.core.view_geometry import Errors, Noise, ViewGeometry
from copem_replay.experiment.file import make_plain_source, parse_experiment
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.perception.observation import Observations, observe_objects
from copem_replay.perception.pem.condition import noise_quantity
from copem_replay.perception.pem.error import ErrorModel
from copem_replay.perception.perceive import perceive
from copem_replay.pipeline.notes import list_notes
from copem_replay.pipeline.prepare import prepare_log
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.oracles.lasting import Series

RUNS = np.arange(4000)
GAUSSIAN = {
    "kind": "gaussian", "covariance_m2": [[1.0, 0.3], [0.3, 0.5]], "yaw_sigma_deg": 5.0, "speed_sigma_mps": 0.4,
    "size_sigma_m": 0.1,
}  # fmt: skip
MAST: dict[str, Any] = {"at": [0, 30], "height_m": 9.0, "pem": "p"}


def two_standing(until_s: float = 2.0, rate_hz: float = 10.0, gap: bool = False) -> Recording:
    there = (lambda t: not 0.45 < t < 3.45) if gap else (lambda t: True)
    things = [
        Thing("ego", "car", standing(0, 0)),
        *(Thing(n, "car", standing(20, y), there) for n, y in (("a", 0), ("b", 9))),
    ]
    return recording(things, until_s=until_s, rate_hz=rate_hz)


def plan(
    memory: dict[str, Any] | None, *, p: Any = 0.3, error: Any = GAUSSIAN, rate_hz: float | None = None, **more: Any
) -> Experiment:
    detection = p if isinstance(p, dict) else {"kind": "constant", "probability": p}
    couple = {"detection": detection} | ({"error": error} if error else {})
    pem: Any = {"couples": [couple], "memory": memory} if memory else [couple]
    units = {name: MAST | {"at": [x, 30], "rate_hz": rate_hz} for name, x in (("u", 0), ("v", 9))}
    return experiment(pems={"p": pem}, units=units, configurations={"all": {"units": "all"}}, **more)


def seen_by(log: Recording, setup: Experiment, runs: Int = RUNS, **more: Any) -> tuple[Tracks, Observations]:
    found = observe_objects(log.scene, log.truth, setup)
    return perceive(log.scene, found, setup, runs, **more), found


def of(tracks: Tracks, log: Recording, unit: str, name: str) -> Int:
    """Rows of one object in the lists of one unit."""
    mine = (tracks.row_unit_ix == tracks.units.index(unit)) & (tracks.row_object_ix == log.scene.object_number[name])
    return np.flatnonzero(mine)


def standardised(valid: Any, p: float) -> Float:
    return (valid - p) / np.sqrt(p * (1 - p))


LASTING: list[list[dict[str, Any]]] = [
    [{"share": 1.0, "correlation_s": 0.8}],
    [{"share": 0.6, "correlation_s": 0.8}, {"share": 0.2, "correlation_s": 20, "of": "unit"}],
    [{"share": 0.5, "correlation_s": 0.3, "path": "drifts"}],
    [{"share": 0.5, "correlation_s": "always"}, {"share": 0.5, "correlation_s": 0.5, "of": "object"}],
    [
        {"share": 0.3, "correlation_s": 2, "of": "all", "path": "drifts"},
        {"share": 0.3, "correlation_s": 1, "of": "all"},
    ],
]


def part_law(part: dict[str, Any], lag_s: float, p: float) -> float:
    """Correlation of two hits that both go by a part: e^(−Δ/τ); of two drifting normals below a threshold, by SciPy."""
    tau = part["correlation_s"]
    same = 1.0 if tau == "always" else float(np.exp(-lag_s / tau))
    if part.get("path") != "drifts" or tau == "always":
        return same
    z = stats.norm.ppf(p)
    both = stats.multivariate_normal([0, 0], [[1, same], [same, 1]]).cdf([z, z]) if same < 1 else p
    return float((both - p * p) / (p * (1 - p)))


@pytest.mark.parametrize("parts", LASTING)
def test_detection_keeps_its_probability_and_lasts_as_declared(parts: list[dict[str, Any]]) -> None:
    """Mean in every list within 4 s.e. of p; correlation of hits Σ share² φ(Δ); to others: what they share."""
    log, setup, p = two_standing(), plan({"detection": parts}, error=None), 0.3
    seen, _ = seen_by(log, setup)
    se = np.sqrt(p * (1 - p) / len(RUNS))
    assert np.abs(seen.valid.mean(axis=0) - p).max() < 4.2 * se
    hits = {(u, o): standardised(seen.valid[:, of(seen, log, u, o)], p) for u in "uv" for o in "ab"}
    for lag in (1, 3, 8):
        expected = sum(part["share"] ** 2 * part_law(part, lag / 10, p) for part in parts)
        found = np.mean(hits["u", "a"][:, lag:] * hits["u", "a"][:, :-lag])
        assert abs(found - expected) < 0.035, lag
    for other, common in ((("u", "b"), ("unit", "all")), (("v", "a"), ("object", "all")), (("v", "b"), ("all",))):
        expected = sum(part["share"] ** 2 for part in parts if part.get("of", "pair") in common)
        assert abs(np.mean(hits["u", "a"] * hits[other]) - expected) < 0.035, other


@pytest.mark.parametrize("parts", LASTING)
def test_errors_keep_their_variance_and_last_as_declared(parts: list[dict[str, Any]]) -> None:
    """Variance 1 m² east and .5 m² north, correlation Σ share e^(−Δ/τ); all of it, though nobody was told."""
    memory = dict.fromkeys(("position", "yaw", "speed", "size"), parts)
    log, setup = two_standing(), plan(memory, p=1.0)
    seen, found = seen_by(log, setup)
    assert seen.cov_ee_m2 is not None
    assert set(seen.cov_ee_m2[0]) == {1.0}, "units do not know how correlated they are"
    columns = {
        "x_m": 1.0, "y_m": np.sqrt(0.5), "yaw_rad": np.deg2rad(5), "length_m": 0.1, "height_m": 0.1, "vx_mps": 0.4,
    }  # fmt: skip
    for name, sigma in columns.items():
        z = (getattr(seen, name) - getattr(found.tracks, name)) / sigma
        assert np.abs(z.var(axis=0) - 1).max() < 5.5 * np.sqrt(2 / len(RUNS)), name  # the worst of 126 rows
        assert stats.kstest(z[:, 7], stats.norm.cdf).pvalue > 1e-4, name
        a = z[:, of(seen, log, "u", "a")]
        for lag in (1, 3, 8):
            expected = sum(
                part["share"] * (1 if part["correlation_s"] == "always" else np.exp(-lag / 10 / part["correlation_s"]))
                for part in parts
            )
            assert abs(np.mean(a[:, lag:] * a[:, :-lag]) - expected) < 0.045, (name, lag)
        for other, common in ((("u", "b"), ("unit", "all")), (("v", "a"), ("object", "all")), (("v", "b"), ("all",))):
            expected = sum(part["share"] for part in parts if part.get("of", "pair") in common)
            assert abs(np.mean(a * z[:, of(seen, log, *other)]) - expected) < 0.045, (name, other)
    independent = np.mean((seen.yaw_rad - found.tracks.yaw_rad) * (seen.vx_mps - found.tracks.vx_mps)) / 0.035
    assert abs(independent) < 0.02


def test_across_a_gap() -> None:
    """An object that is away for 3 s is remembered as long as everything is."""
    log = two_standing(4.0, gap=True)
    parts = [{"share": 1.0, "correlation_s": 5.0}]
    seen, _ = seen_by(log, plan({"detection": parts, "position": parts}, p=0.5))
    rows = of(seen, log, "u", "a")
    hits = standardised(seen.valid[:, rows], 0.5)
    before, after = 4, 5  # captured at 0.4 s and 3.5 s
    assert np.diff(seen.row_captured_s[rows])[before] == pytest.approx(3.1)
    assert abs(np.mean(hits[:, before] * hits[:, after]) - np.exp(-3.1 / 5)) < 4.5 / np.sqrt(len(RUNS))


@pytest.mark.parametrize("tau_s", [0.2, 3.0])
def test_law_across_a_change_of_couple(tau_s: float) -> None:
    """A car drives from one couple into another: the law of each from its first list on, and the path goes on."""
    log = recording([Thing("ego", "car", standing(0, 0)), Thing("a", "car", driving(20, 0, 10))], until_s=2.0)
    memory = {name: [{"share": 0.8, "correlation_s": tau_s}] for name in ("detection", "position")}
    couples = [
        {"when": {"range_m": [0, 30]}, "detection": {"kind": "constant", "probability": 0.9},
         "error": {"kind": "gaussian", "covariance_m2": [[0.25, 0], [0, 0.25]]}},
        {"detection": {"kind": "constant", "probability": 0.2},
         "error": {"kind": "gaussian", "covariance_m2": [[4, 0], [0, 4]], "mean_m": [3, 0]}},
    ]  # fmt: skip
    setup = experiment(
        pems={"p": {"couples": couples, "memory": memory}}, units={"ego": {"on": "ego", "height_m": 2, "pem": "p"}},
        configurations={"all": {"units": "all"}},
    )  # fmt: skip
    seen, found = seen_by(log, setup)
    near = found.couple_ix == 0
    p = np.where(near, 0.9, 0.2)
    assert (np.abs(seen.valid.mean(axis=0) - p) < 4.2 * np.sqrt(p * (1 - p) / len(RUNS))).all()
    error = seen.x_m - found.tracks.x_m
    z = np.where(near, error / 0.5, (error - 3) / 2)
    for row in range(len(p)):
        assert stats.kstest(z[seen.valid[:, row], row], stats.norm.cdf).pvalue > 1e-5, row
    last = int(np.flatnonzero(near)[-1])
    both = seen.valid[:, last] & seen.valid[:, last + 1]
    expected = 0.8 * np.exp(-0.1 / tau_s)
    found_corr = np.corrcoef(z[both, last], z[both, last + 1])[0, 1]
    assert abs(found_corr - expected) < 4.5 / np.sqrt(both.sum())


def test_a_couples_own_memory_replaces_the_pems() -> None:
    lasts = [{"share": 1.0, "correlation_s": "always"}]
    own = {"detection": {"kind": "constant", "probability": 0.5}, "when": {"range_m": [0, 25]}, "memory": {}}
    other = {"detection": {"kind": "constant", "probability": 0.5}}
    log = recording([Thing("ego", "car", standing(0, 0)), Thing("a", "car", driving(20, 0, 5))], until_s=2.0)
    setup = experiment(
        pems={"p": {"couples": [own, other], "memory": {"detection": lasts}}},
        units={"ego": {"on": "ego", "height_m": 2, "pem": "p"}}, configurations={"all": {"units": "all"}},
    )  # fmt: skip
    seen, found = seen_by(log, setup, np.arange(50))
    own_rows, others = (np.flatnonzero(found.couple_ix == c) for c in (0, 1))
    assert (seen.valid[:, others] == seen.valid[:, others[:1]]).all()
    assert not (seen.valid[:, own_rows] == seen.valid[:, own_rows[:1]]).all()
    fresh, _ = seen_by(
        log,
        experiment(
            pems={"p": [{"detection": own["detection"]}]},
            units={"ego": {"on": "ego", "height_m": 2, "pem": "p"}},
            configurations={"all": {"units": "all"}},
        ),
        np.arange(50),
    )
    np.testing.assert_array_equal(seen.valid[:, own_rows], fresh.valid[:, own_rows])


class Flipping(ErrorModel):
    """A user's own: the heading is turned round now and then."""

    kind: str = "tests.perception.test_memory:Flipping"

    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        none = np.zeros(len(view.range_m))
        still = np.zeros_like(noise("flip"))
        return Errors(
            still, still, none, none, none, yaw_rad=np.where(noise("flip") > 1, np.pi, 0.0), yaw_var_rad2=none
        )


def test_own_models_remember_without_knowing() -> None:
    log = two_standing()
    own = {"kind": "tests.perception.test_memory:Flipping"}
    lasts = [{"share": 1.0, "correlation_s": 0.7, "path": "held"}]
    seen, _ = seen_by(log, plan({"flip": lasts}, p=1.0, error=own))
    rate = stats.norm.sf(1)
    flips = standardised(np.abs(seen.yaw_rad[:, of(seen, log, "u", "a")]) > 3, rate)
    assert abs(np.mean(flips[:, 3:] * flips[:, :-3]) - np.exp(-0.3 / 0.7)) < 0.03


@given(
    part=st.fixed_dictionaries(
        {
            "share": st.sampled_from([0.4, 1.0]),
            "correlation_s": st.sampled_from([0.05, 1.0, 50.0, "always"]),
            "of": st.sampled_from(["pair", "unit", "object", "all"]),
            "path": st.sampled_from(["held", "drifts"]),
        }
    ),
    low=st.floats(0, 1), more=st.floats(0, 1), kind=st.sampled_from(["constant", "table", "visible_share"]),
)  # fmt: skip
@settings(max_examples=25, deadline=None)  # each perceives twenty runs twice
def test_a_higher_probability_only_adds_detections(part: dict[str, Any], low: float, more: float, kind: str) -> None:
    log = two_standing(1.0)
    high = low + (1 - low) * more
    of_kind: dict[str, list[dict[str, Any]]] = {
        "constant": [{"kind": "constant", "probability": p} for p in (low, high)],
        "table": [{"kind": "table", "range_m": [10, 40], "probability": [[p], [p / 2]]} for p in (low, high)],
        "visible_share": [{"kind": "constant", "probability": 0.0}, {"kind": "visible_share"}],
    }
    few, many = (seen_by(log, plan({"detection": [part]}, p=p, error=None), np.arange(20))[0] for p in of_kind[kind])
    assert (many.valid | ~few.valid).all()


def test_listed_rows_do_not_depend_on_what_else_is_asked() -> None:
    """A run alone, a row alone, another unit beside it, states or none: the same bits."""
    log = two_standing()
    memory = {"detection": LASTING[1], "position": LASTING[2], "yaw": LASTING[4]}
    setup = plan(memory)
    whole, found = seen_by(log, setup, np.arange(6))
    np.testing.assert_array_equal(whole.valid, perceive(log.scene, found, setup, np.arange(6), states="true").valid)
    alone, _ = seen_by(log, setup, np.array([4]))
    for name in ("valid", "x_m", "yaw_rad"):
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(whole, name)[4])
    rows = np.arange(1, len(found.probability), 3)
    some = perceive(log.scene, found.take_rows(rows), setup, np.arange(6))
    shown = whole.valid[:, rows]
    np.testing.assert_array_equal(some.valid, shown)
    for name in ("x_m", "y_m", "yaw_rad"):
        np.testing.assert_array_equal(
            np.where(shown, getattr(some, name), 0), np.where(shown, getattr(whole, name)[:, rows], 0)
        )
    fewer = setup.model_copy(update={"units": {"v": setup.units["v"]}})
    other, _ = seen_by(log, fewer, np.arange(6))
    mine = np.flatnonzero(whole.row_unit_ix == 1)
    np.testing.assert_array_equal(other.valid, whole.valid[:, mine])
    np.testing.assert_array_equal(other.x_m, whole.x_m[:, mine])


def test_held_detection_is_the_same_at_common_stamps_of_any_rate() -> None:
    log = two_standing(3.0)
    parts = [{"share": 1.0, "correlation_s": 0.5}]
    fast, slow = (
        seen_by(log, plan({"detection": parts}, error=None, rate_hz=r), np.arange(40))[0] for r in (20.0, 10.0)
    )
    np.testing.assert_array_equal(
        fast.valid[:, of(fast, log, "u", "a")][:, ::2], slow.valid[:, of(slow, log, "u", "a")]
    )


def test_an_autoregression_fits_what_drifts() -> None:
    """The estimator of statsmodels finds the correlation time and the fresh share: an AR(1) seen with noise."""
    statespace = pytest.importorskip("statsmodels.tsa.statespace.sarimax", reason="statsmodels is not installed")
    log = recording([Thing("ego", "car", standing(0, 0)), Thing("a", "car", standing(20, 0))], until_s=200.0)
    parts = [{"share": 0.7, "correlation_s": 1.0}]
    seen, found = seen_by(log, plan({"position": parts}, p=1.0), np.arange(1))
    z = (seen.x_m - found.tracks.x_m)[0, of(seen, log, "u", "a")]
    fit = statespace.SARIMAX(z, order=(1, 0, 0), measurement_error=True).fit(disp=False)
    phi, noise, step = (
        float(dict(zip(fit.model.param_names, fit.params, strict=True))[n])
        for n in ("ar.L1", "var.measurement_error", "sigma2")
    )
    assert phi == pytest.approx(np.exp(-0.1), abs=0.03)
    assert noise == pytest.approx(0.3, abs=0.06)
    assert step / (1 - phi**2) == pytest.approx(0.7, abs=0.2)


def test_by_which_part_a_list_goes_and_where_its_numbers_are() -> None:
    """By the plain oracle: the choice among cumulative shares, and the address of each number."""
    log = two_standing(1.0)
    parts = [
        {"share": 0.3, "correlation_s": 0.5}, {"share": 0.2, "correlation_s": 0.5, "of": "unit"},
        {"share": 0.1, "correlation_s": 2.0}, {"share": 0.1, "correlation_s": "always", "of": "all"},
    ]  # fmt: skip
    seen, _ = seen_by(log, plan({"detection": parts}, error=None), np.arange(30))
    row_of = {("u", "a"): of(seen, log, "u", "a"), ("v", "b"): of(seen, log, "v", "b")}
    everyone = stable_hash("everyone")
    for (unit, name), rows in row_of.items():
        word = stable_hash("object", name)
        for run in range(30):
            for row in rows:
                stamp = int(seen.stamp_ns[seen.frame_ix[row]])

                def numbers(purpose: str, unit: str = unit, word: int = word, run: int = run) -> Series:
                    return Series(7, log.scene.log, purpose, unit, word, run)

                choice = numbers("detection part").uniforms(stamp)[0]
                number = (
                    numbers("detection pair 0 held").held(5e8, stamp)[0] if choice < 0.3
                    else numbers("detection unit 0 held", word=everyone).held(5e8, stamp)[0] if choice < 0.5
                    else numbers("detection pair 1 held").held(2e9, stamp)[0] if choice < 0.6
                    else numbers("detection all 0 held", unit="", word=everyone).uniforms(0)[0] if choice < 0.7
                    else numbers("detection").uniforms(stamp)[0]
                )  # fmt: skip
                assert seen.valid[run, row] == (number < 0.3)


@pytest.mark.parametrize("path", ["held", "drifts"])
@pytest.mark.parametrize("of", ["pair", "unit", "object", "all"])
@pytest.mark.parametrize("correlation_s", [1.0, "always"])
def test_no_rows_no_numbers(of: str, path: str, correlation_s: Any) -> None:
    log = two_standing(1.0)
    parts = [{"share": 0.5, "correlation_s": correlation_s, "of": of, "path": path}]
    setup = plan({"detection": parts, "position": parts})
    _, found = seen_by(log, setup, np.arange(3))
    none = perceive(log.scene, found.take_rows(np.empty(0, dtype=np.int64)), setup, np.arange(3))
    assert none.valid.shape == (3, 0)


def test_names_of_noise() -> None:
    names = ("position 1", "yaw", "length", "width", "height", "speed", "flip")
    assert [noise_quantity(name) for name in names] == ["position", "yaw", "size", "size", "size", "speed", "flip"]


# ---- what is said -------------------------------------------------------------------------------------------------

COUPLE = {
    "detection": {"kind": "constant", "probability": 0.5},
    "error": {"kind": "gaussian", "covariance_m2": [[1, 0], [0, 1]], "yaw_sigma_deg": 1},
}


def said(pem: Any, **more: Any) -> list[str]:
    base = {"version": 1, "pems": {"lidar": pem}, "configurations": {"GT": {"units": "truth"}}}
    return [line.removeprefix("experiment: ") for line in find_problems(make_plain_source(base | more))[1]]


@pytest.mark.parametrize(
    ("memory", "expected"),
    [
        ({"detection": [{"share": 0.6, "correlation_s": 1}] * 2}, "detection: shares sum to 1.2, expected at most 1"),
        (
            {"position": [{"share": 0.6, "correlation_s": 0}]},
            "position[0].correlation_s: 0 is what the rest is anyway; leave the part out",
        ),
        ({"position": [{"share": 2, "correlation_s": 1}]}, "position[0].share: expected at most 1, found 2"),
        (
            {"yaw": [{"share": 1, "correlation_s": 1e5}]},
            "yaw[0].correlation_s: expected at most 86400, or 'always', found 100000.0",
        ),
        (
            {"flip": [{"share": 0.6, "correlation_s": 1}]},
            'flip: no model of this PEM asks for noise "flip" (they ask for position, yaw)',
        ),
    ],
)
def test_messages(memory: dict[str, Any], expected: str) -> None:
    assert said({"couples": [COUPLE], "memory": memory}) == [f"pems.lidar.memory.{expected}"]


def test_a_couple_says_what_its_own_model_does_not_ask_for() -> None:
    flip = {"memory": {"flip": [{"share": 0.6, "correlation_s": 1}]}}
    assert said([COUPLE, COUPLE | flip]) == [
        'pems.lidar[1].memory.flip: no model of this couple asks for noise "flip" (they ask for position, yaw)'
    ]
    own = {"error": {"kind": "tests.perception.test_memory:Flipping"}}
    assert said([COUPLE, COUPLE | own | flip]) == []


def test_posterior_has_no_memory() -> None:
    lasts = {"memory": {"position": [{"share": 0.6, "correlation_s": 1}]}}
    units = {"m": {"at": [0, 0], "height_m": 5, "pem": "lidar"}}
    fused = {"X": {"units": "all", "fusion": {"kind": "ideal", "combine": "posterior"}}}
    expected = ["configurations.X.fusion.combine: posterior draws anew at each instant and has no memory; use samples"]
    assert said({"couples": [COUPLE]} | lasts, units=units, configurations=fused) == expected
    assert said([COUPLE | lasts], units=units, configurations=fused) == expected
    assert said([COUPLE], units=units, configurations=fused) == []


def test_what_is_remembered_in_vain_is_noted() -> None:
    log = two_standing()
    setup = plan(
        {"yaw": [{"share": 1, "correlation_s": 1}]}, error={"kind": "gaussian", "covariance_m2": [[1, 0], [0, 1]]}
    )
    notes = list_notes([log], [prepare_log(log, setup)], setup, replayed=False)
    assert "pems.p.memory.yaw: no couple has a yaw error, nothing to remember" in notes


def test_a_list_of_couples_is_the_short_form_and_stays_one() -> None:
    """What an experiment does not say is not in what is written of it: memory, sweeps of it."""
    short, _ = parse_experiment(
        make_plain_source(
            {
                "version": 1,
                "logs": ["a"],
                "pems": {"p": [COUPLE]},
                "configurations": {"GT": {"units": "truth"}},
                "sweep": {"latency_s": [1]},
            }
        )
    )
    whole, _ = parse_experiment(
        make_plain_source(
            {
                "version": 1,
                "logs": ["a"],
                "pems": {"p": {"couples": [COUPLE]}},
                "configurations": {"GT": {"units": "truth"}},
            }
        )
    )
    assert short is not None
    assert whole is not None
    assert short.pems == whole.pems
    written = short.as_written()
    assert isinstance(written["pems"]["p"], list)
    assert "memory" not in str(written)
    assert "correlation_s" not in str(written)
    memory = {"yaw": [{"share": 1.0, "correlation_s": "always"}]}
    kept = replace_memory(short, memory).as_written()["pems"]["p"]
    assert kept == {"couples": written["pems"]["p"], "memory": {"yaw": [memory["yaw"][0] | {"of": "pair"}]}}
    assert Experiment.model_validate(replace_memory(short, memory).as_written()).pems["p"].memory["yaw"][0].share == 1


def replace_memory(setup: Experiment, memory: dict[str, Any]) -> Experiment:
    data = setup.as_written()
    return Experiment.model_validate(data | {"pems": {"p": {"couples": data["pems"]["p"], "memory": memory}}})
