"""Exact times, sweeps and chunks where draws last: against runs, against hand-worked values, and refused where none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.experiment.file import make_plain_source
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import cut_blocks
from copem_replay.pipeline.run import run_experiment
from copem_replay.pipeline.sweep import list_points
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.pipeline.test_chunking import assert_same, both_ways, traffic
from tests.pipeline.test_closed_form import band, farthest, pairs, refused

FADING = {"kind": "table", "range_m": [10, 30], "probability": [[0.5], [0.02]]}
EXACT = {"onset": {"kind": "appears"}, "exact": True}
Parts = list[dict[str, Any]]


def coming(until_s: float = 3.0, rate_hz: float = 10.0) -> Any:
    """A pedestrian comes nearer, so that p rises from list to list, and another goes away."""
    things = [
        Thing("ego", "car", standing(0, 0)),
        Thing("a", "pedestrian", driving(30, 0, -5)),
        Thing("b", "pedestrian", driving(12, 3, 4)),
    ]
    return recording(things, until_s=until_s, rate_hz=rate_hz)


def plan(parts: Parts, others: Parts | None = None, **more: Any) -> Experiment:
    """Two masts at rates of their own, with memory of detection each."""

    def pem(parts: Parts | None) -> Any:
        couples = [{"detection": FADING}]
        return {"couples": couples, "memory": {"detection": parts}} if parts else couples

    units = {
        "m": {"at": [0, 2], "height_m": 5, "pem": "p", "rate_hz": 10},
        "n": {"at": [0, -2], "height_m": 5, "pem": "q", "rate_hz": 7, "phase_s": 0.03},
    }
    base: dict[str, Any] = {
        "pems": {"p": pem(parts), "q": pem(parts if others is None else others)}, "units": units, "runs": 20_000,
        "configurations": {"all": {"units": "all", "latency_s": 0.1}, "one": {"units": ["m"]}}, "measure": EXACT,
    }  # fmt: skip
    return experiment(**(base | more))


LASTING: dict[str, tuple[Parts, Parts | None]] = {
    "a part of a pair, and one of a unit": (
        [{"share": 0.8, "correlation_s": 0.5}],
        [{"share": 1.0, "correlation_s": 2.0, "of": "unit"}],
    ),
    "always, and nothing": ([{"share": 0.7, "correlation_s": "always"}], []),
    "numbers that two units share": ([{"share": 0.8, "correlation_s": 0.7, "of": "object"}], None),
    "numbers of everybody": ([{"share": 1.0, "correlation_s": "always", "of": "all"}], None),
    "shared by two in different parts": (
        [{"share": 1.0, "correlation_s": 0.7, "of": "object"}],
        [{"share": 0.5, "correlation_s": 0.7, "of": "object"}],
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("case", LASTING)
def test_the_runs_are_within_the_band_of_the_exact_distribution(case: str) -> None:
    """20 000 runs of each; without memory in the closed form they are outside."""
    measured = EXACT | {"accuracy": False}
    result = run_experiment(plan(*LASTING[case], measure=measured), [coming()])
    memoryless = run_experiment(plan([], runs=1, measure=measured), [coming()])
    assert result.exact is not None
    assert len(pairs(result)) == 4
    outside = 0
    for (key, runs, rows), (_, _, without) in zip(pairs(result), pairs(memoryless), strict=True):
        assert farthest(runs["detection_s"].to_numpy(), rows) <= band(20_000, 1e-7), key
        outside += farthest(runs["detection_s"].to_numpy(), without) > band(20_000, 1e-7)
    assert outside >= 2


def test_a_fleet_whose_units_last() -> None:
    things = [Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", driving(30, 0, -5))]
    things += [Thing(f"c{k}", "car", standing(5 * k - 40, 9)) for k in range(3)]
    fleet = {"f": {"on": {"classes": ["car"], "penetration_rate": 0.4}, "pem": "p"}}
    measured = EXACT | {"accuracy": False, "objects": {"classes": ["pedestrian"]}}
    setup = plan(
        [{"share": 0.9, "correlation_s": 1.0}], units=fleet, configurations={"all": {"units": "all"}}, measure=measured
    )
    result = run_experiment(setup, [recording(things, until_s=2.0)])
    [(_, runs, rows)] = pairs(result)
    assert 0.05 < rows["probability"].iloc[-1] < 0.95
    assert farthest(runs["detection_s"].to_numpy(), rows) <= band(20_000, 1e-7)


@pytest.mark.parametrize("rate_hz", [10.0, 50.0, 200.0])
def test_time_to_detection_hardly_depends_on_the_list_rate(rate_hz: float) -> None:
    """P(T > t) = (1 − p) e^(−p t / τ), to within 1 / (rate τ): sampled and exact. Memoryless, it goes to 0."""
    things = [Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", standing(20, 0))]
    log, p, tau_s = recording(things, until_s=2.0), 0.3, 1.0
    pem = {"couples": [{"detection": {"kind": "constant", "probability": p}}],
           "memory": {"detection": [{"share": 1.0, "correlation_s": tau_s}]}}  # fmt: skip
    units = {"m": {"at": [0, 2], "height_m": 5, "pem": "p", "rate_hz": rate_hz}}
    setup = experiment(
        pems={"p": pem},
        units=units,
        runs=4000,
        configurations={"m": {"units": "all"}},
        measure=EXACT | {"accuracy": False},
    )
    result = run_experiment(setup, [log])
    assert result.exact is not None
    for t in (0.5, 1.0, 2.0):
        expected = (1 - p) * math.exp(-p * t / tau_s)
        detected = result.exact["detection_s"] <= t + 1e-6
        exact = 1 - result.exact.loc[detected, "probability"].sum()
        assert exact == pytest.approx(expected, abs=1 / (rate_hz * tau_s))
        sampled = 1 - (study_rows(result)["detection_s"] <= t + 1e-6).mean()
        assert sampled == pytest.approx(exact, abs=4.5 * math.sqrt(0.25 / 4000))


# ---- refused ------------------------------------------------------------------------------------------------------

TWO = [{"share": 0.5, "correlation_s": 1}, {"share": 0.2, "correlation_s": "always"}]


@pytest.mark.parametrize(
    ("setup", "expected"),
    [
        (
            plan(TWO),
            "exact: configuration all: detection of unit m has two lasting parts, which has no closed form here; leave "
            "one, or leave exact out",
        ),
        (
            plan([{"share": 0.5, "correlation_s": 1, "path": "drifts"}]),
            "exact: configuration all: detection of unit m drifts, which has no closed form; use `path: held`, or "
            "leave exact out",
        ),
        (
            plan(TWO[:1], measure=EXACT | {"confirm": {"hits": 2, "of": 3}}),
            "exact: configuration all: detection of unit m lasts, and confirmation by several hits then has no closed "
            "form; confirm with one hit, or leave exact out",
        ),
        (
            plan(*([{"share": 0.5, "correlation_s": tau, "of": "object"}] for tau in (1, 2))),
            "exact: configuration all: units m and n have the numbers of `of: object` in common with two correlation "
            "times, which has no closed form; give them one, or leave exact out",
        ),
        (
            plan(
                [{"share": 0.5, "correlation_s": 1, "of": "object"}],
                configurations={"late": {"units": "all", "latency_s": {"m": 0.4}}},
            ),
            "scene: exact: configuration late: lists of the 2 units m, n arrive in another order than they were "
            "captured in, and detection that lasts then has no closed form; give them one constant latency, or leave "
            "exact out",
        ),
    ],
)  # fmt: skip
def test_what_has_no_closed_form(setup: Experiment, expected: str) -> None:
    assert refused(setup, coming()) == expected


def test_couples_that_last_otherwise_and_fleets_that_share_are_refused() -> None:
    own = {"memory": {"detection": [{"share": 0.5, "correlation_s": 3}]}, "when": {"range_m": [0, 20]}}
    pem = {"couples": [{"detection": FADING} | own, {"detection": FADING}], "memory": {"detection": TWO[:1]}}
    one = {"m": {"at": [0, 2], "height_m": 5, "pem": "p"}}
    setup = plan([], pems={"p": pem}, units=one, configurations={"all": {"units": "all"}})
    assert "detection of unit m lasts otherwise from couple to couple" in refused(setup, coming())
    shared = {"couples": [{"detection": FADING}], "memory": {"detection": [TWO[0] | {"of": "all"}]}}
    fleet = {"f": {"on": {"classes": ["pedestrian"], "penetration_rate": 0.4}, "pem": "p"}}
    setup = plan([], pems={"p": shared}, units=fleet, configurations={"all": {"units": "all"}})
    assert "unit f:a is only in some runs" in refused(setup, coming())


def test_memory_of_errors_leaves_exact_times_as_they_are() -> None:
    couples = [{"detection": FADING, "error": {"kind": "gaussian", "covariance_m2": [[1, 0], [0, 1]]}}]
    memory = {"position": TWO, "yaw": TWO}
    setups = [plan([], runs=1, pems={"p": pem, "q": pem}) for pem in (couples, {"couples": couples, "memory": memory})]
    without, with_memory = (run_experiment(setup, [coming()]).exact for setup in setups)
    pd.testing.assert_frame_equal(without, with_memory, check_exact=True)


# ---- sweeps -------------------------------------------------------------------------------------------------------


def test_a_sweep_of_the_correlation_time() -> None:
    """0 is the memoryless unit, a value what a PEM with it gives; a configuration without memory has no curve."""
    parts = [{"share": 1.0, "correlation_s": 5.0}]
    measured = EXACT | {"accuracy": False}
    configurations = {"GT": {"units": "truth"}, "m": {"units": ["m"]}, "n": {"units": ["n"]}}
    setup = plan(
        parts, [], runs=300, measure=measured, configurations=configurations, sweep={"correlation_s": [0, 0.5]}
    )
    assert [(p.sweep, p.value, list(p.experiment.configurations)) for p in list_points(setup)] == [
        ("correlation_s", 0, ["m"]), ("correlation_s", 0.5, ["m"]),
    ]  # fmt: skip
    swept = run_experiment(setup, [coming()]).sweep
    assert swept is not None
    half = [{"share": 1.0, "correlation_s": 0.5}]
    other = run_experiment(
        plan(half, [], runs=300, measure=measured, configurations=configurations), [coming()]
    ).summary
    mine = swept[(swept["value"] == 0.5) & (swept["configuration"] == "m")].iloc[0]
    theirs = other[other["configuration"] == "m"].iloc[0]
    for column in ("detected_share", "detected_share_exact", "ttd_median_s", "ttd_rmst_s_exact"):
        assert mine[column] == theirs[column], column
    fresh = run_experiment(plan([], [], runs=300, measure=measured, configurations=configurations), [coming()]).summary
    none = swept[swept["value"] == 0].iloc[0]
    theirs = fresh[fresh["configuration"] == "m"].iloc[0]
    assert none["detected_share_exact"] == pytest.approx(theirs["detected_share_exact"], rel=1e-12)
    assert none["detected_share"] == pytest.approx(theirs["detected_share"], abs=0.1)


def test_a_sweep_that_nothing_remembers_is_refused() -> None:
    data = {
        "version": 1, "pems": {"p": [{"detection": FADING}]}, "units": {"m": {"at": [0, 2], "height_m": 5, "pem": "p"}},
        "configurations": {"all": {"units": "all"}}, "sweep": {"correlation_s": [1]},
    }  # fmt: skip
    assert find_problems(make_plain_source(data))[1] == [
        "experiment: sweep.correlation_s: no PEM has `memory: {detection: […]}`"
    ]
    assert find_problems(make_plain_source(data | {"sweep": {"correlation_s": [0.0001]}}))[1] == [
        "experiment: sweep.correlation_s[0]: expected 0 or at least 0.001 (s), found 0.0001",
        "experiment: sweep.correlation_s: no PEM has `memory: {detection: […]}`",
    ]


# ---- chunks -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [60, 333])
@pytest.mark.parametrize("path", ["held", "drifts"])
@pytest.mark.parametrize("of", ["pair", "unit", "object", "all"])
def test_chunks_have_the_same_bits(of: str, path: str, rows: int) -> None:
    parts = [
        {"share": 0.6, "correlation_s": 0.4, "of": of, "path": path},
        {"share": 0.3, "correlation_s": "always", "of": of},
    ]
    couple = {
        "when": {"range_m": [0, 45]},
        "detection": {"kind": "constant", "probability": 0.6},
        "error": {
            "kind": "gaussian",
            "covariance_m2": [[0.5, 0.1], [0.1, 0.3]],
            "speed_sigma_mps": 0.3,
            "yaw_sigma_deg": 3.0,
        },
    }
    memory = dict.fromkeys(("detection", "position", "speed", "yaw"), parts)
    units = {
        "ego": {"on": "ego", "height_m": 1.8, "pem": "p"},
        "mast": {"at": [15.0, 8.0], "height_m": 5.0, "pem": "p", "rate_hz": 23.0, "phase_s": 0.03},
        "car": {"on": "blinking", "height_m": 1.5, "pem": "p"},
    }
    fusions = {"ideal": {"kind": "ideal"}, "tracker": {"kind": "tracker", "late": "replay"}}
    setup = experiment(
        runs=2, pems={"p": {"couples": [couple], "memory": memory}}, units=units,
        measure={"onset": {"kind": "appears"}},
        configurations={name: {"units": "all", "latency_s": {"mast": 0.3}, "fusion": f} for name, f in fusions.items()},
    )  # fmt: skip
    whole, pieces = both_ways(setup, [traffic()], rows)
    assert len(pieces.logs[0].replay().chunks) > 1
    assert_same(whole, pieces)


def test_blocks_are_smaller_where_detection_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The numbers themselves are held then, not one byte each."""
    monkeypatch.setattr("copem_replay.pipeline.replay.BLOCK_BYTES", 1_000_000)
    measured = {"onset": {"kind": "appears"}, "accuracy": False}
    sizes = []
    for parts in ([], LASTING["numbers that two units share"][0]):
        setup = plan(parts, runs=100_000, measure=measured)
        replay = prepare_log(coming(), setup)
        sizes.append(max(map(len, cut_blocks(replay, setup, 1))))
        rows = len(replay.measured.tracks.frame_ix)
    assert sizes == [1_000_000 // rows, 1_000_000 // (40 * rows)]


def test_more_workers_and_blocks_have_the_same_bits() -> None:
    setup = plan(LASTING["numbers that two units share"][0], runs=9, measure={"onset": {"kind": "appears"}})
    one, many = (study_rows(run_experiment(setup, [coming()], jobs=jobs)) for jobs in (1, 4))
    pd.testing.assert_frame_equal(one, many, check_exact=True)
    assert one["detection_s"].nunique() > 2
    assert np.isfinite(one["detection_s"]).any()
