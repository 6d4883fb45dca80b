"""Addressed random numbers: the published generator, and what addressing buys."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numba import njit
from scipy import stats
from scipy.special import ndtri

from copem_replay.core.random import CounterRng, RandomKey, normal_quantile, object_words, philox4x32, stable_hash
from copem_replay.core.tracks import Tracks
from copem_replay.io.recording import Recording
from copem_replay.metrics.detections_table import build_frame
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import cut_blocks, replay_outcomes
from copem_replay.pipeline.run import run_experiment
from copem_replay.pipeline.tables import add_row_accuracy
from tests.helpers.replays import study_rows
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

normal_quantile = njit(normal_quantile)  # as kernels call it


def words(*hexadecimal: str) -> tuple[np.uint64, ...]:
    return tuple(np.uint64(int(h, 16)) for h in hexadecimal)


@pytest.mark.parametrize(
    ("counter_and_key", "expected"),
    [
        (["0"] * 6, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        (["ffffffff"] * 6, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        (
            ["243f6a88", "85a308d3", "13198a2e", "03707344", "a4093822", "299f31d0"],
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_known_answers_of_philox4x32_10(counter_and_key: list[str], expected: str) -> None:
    """Source: the known-answer file of Random123 (Salmon et al. 2011)."""
    assert philox4x32(*words(*counter_and_key)) == words(*expected.split())


def test_normal_quantile_is_the_inverse_of_the_normal_distribution() -> None:
    u = np.concatenate([np.logspace(-300, -1, 500), np.linspace(0.01, 0.99, 999), 1 - np.logspace(-15, -1, 200)])
    ours = np.array([normal_quantile(v) for v in u])
    np.testing.assert_allclose(ours, ndtri(u), rtol=1e-14, atol=1e-15)
    assert (np.diff(ours[np.argsort(u)]) >= 0).all(), "monotone, so that common draws stay ordered"


def test_stable_hash_is_pinned() -> None:
    """Results of an old seed must come again with any later version: these numbers may never change."""
    assert stable_hash(1, "log", "detection", "ego") == 0x34D53CA429D4822C


ROWS = 2000


def random_key(**changes: Any) -> RandomKey:
    base = RandomKey(
        ("a", "b"),
        np.arange(ROWS) % 2,
        object_words([str(k % 7) for k in range(ROWS)]),
        np.arange(ROWS) * 100_000_000 + 1_700_000_000_000_000_000,
    )
    return replace(base, **changes)


@pytest.mark.parametrize("draw", ["uniform", "normal"])
def test_numbers_have_the_law_they_should(draw: str) -> None:
    numbers = getattr(CounterRng(1, "log"), draw)("purpose", random_key(), np.arange(100)).ravel()
    law = stats.uniform if draw == "uniform" else stats.norm
    assert stats.kstest(numbers, law.cdf).pvalue > 1e-4
    if draw == "uniform":
        assert 0 < numbers.min() < numbers.max() < 1


@pytest.mark.parametrize("axis", [0, 1])
def test_neighbours_are_independent(axis: int) -> None:
    numbers = CounterRng(3, "log").normal("purpose", random_key(), np.arange(200))
    a, b = (numbers[:-1], numbers[1:]) if axis == 0 else (numbers[:, :-1], numbers[:, 1:])
    z = np.mean(a * b) * np.sqrt(a.size)
    assert abs(z) < 4.5


def test_every_part_of_the_address_matters() -> None:
    base = CounterRng(1, "log").uniform("p", random_key(), np.arange(3))
    others = {
        "seed": CounterRng(2, "log").uniform("p", random_key(), np.arange(3)),
        "log": CounterRng(1, "other").uniform("p", random_key(), np.arange(3)),
        "purpose": CounterRng(1, "log").uniform("q", random_key(), np.arange(3)),
        "unit": CounterRng(1, "log").uniform("p", random_key(units=("x", "y")), np.arange(3)),
        "run": CounterRng(1, "log").uniform("p", random_key(), np.arange(3, 6)),
        "object": CounterRng(1, "log").uniform("p", random_key(object_word=object_words(["z"] * ROWS)), np.arange(3)),
        "stamp": CounterRng(1, "log").uniform("p", random_key(stamp_ns=random_key().stamp_ns + 1), np.arange(3)),
    }
    for name, other in others.items():
        assert (base == other).mean() == 0, name


def test_bernoulli_is_the_uniform_below_p_and_where_only_spares_work() -> None:
    rng, runs = CounterRng(1, "log"), np.arange(5)
    p = np.linspace(0, 1, ROWS)
    np.testing.assert_array_equal(rng.bernoulli("p", random_key(), runs, p), rng.uniform("p", random_key(), runs) < p)
    where = rng.bernoulli("p", random_key(), runs, p)
    full = rng.normal("e", random_key(), runs)
    np.testing.assert_array_equal(rng.normal("e", random_key(), runs, where), np.where(where, full, 0.0))


# ---- the three properties, through the whole replay ---------------------------------------------------------------


def busy_log(log: str = "busy", *, without: str = "", from_s: float = 0.0, more: bool = False) -> Recording:
    """An ego driving through eight standing or crossing objects; `more` adds another, `without` leaves one out."""
    things = [Thing("ego", "car", driving(0, 0, 8))]
    things += [Thing(f"p{k}", "pedestrian", driving(10 + 7 * k, 4 + k, 0, -0.5)) for k in range(4)]
    things += [Thing(f"c{k}", "car", standing(15 + 9 * k, -4)) for k in range(4)]
    if more:
        things.insert(2, Thing("late", "truck", standing(30, 9)))
    return recording([t for t in things if t.name != without], until_s=4.0, log=log, from_s=from_s)


GAUSSIAN = {"kind": "gaussian", "covariance_m2": [[1.0, 0.2], [0.2, 0.5]]}
PEMS = {"sure": [{"detection": {"kind": "constant", "probability": 0.15}, "error": GAUSSIAN}]}
UNITS: dict[str, Any] = {"ego": EGO_UNIT, "rsu": {"at": [20, 12], "height_m": 5.0, "pem": "sure"}}
CONFIGURATIONS: dict[str, Any] = {
    "PEM": {"units": ["ego"]},
    "both": {"units": ["ego", "rsu"], "latency_s": {"ego": 0, "default": 0.25}},
}


def plan(runs: int = 12, **changes: Any) -> Any:
    base = {
        "pems": PEMS, "units": UNITS, "configurations": CONFIGURATIONS, "runs": runs,
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"]},
    }  # fmt: skip
    return experiment(**(base | changes))


def rows_of(table: Any, **wanted: Any) -> Any:
    for name, value in wanted.items():
        table = table[table[name].isin(value if isinstance(value, list) else [value])]
    return table.reset_index(drop=True)


def test_a_run_alone_is_the_same_run_in_a_batch_and_in_any_block() -> None:
    log = busy_log()
    whole = study_rows(run_experiment(plan(), [log]))
    ready = prepare_log(log, plan())
    for cut in ([0], [5], [11], [3, 4, 5], [0, 7]):
        part = pd.concat([build_frame(add_row_accuracy(one)) for one in replay_outcomes(ready, plan(), np.array(cut))])
        expected = rows_of(whole, run=cut)
        keys = ["configuration", "run", "object_id"]
        assert part.sort_values(keys).reset_index(drop=True).equals(expected.sort_values(keys).reset_index(drop=True))
    for jobs in (1, 2, 5):
        assert (len(cut_blocks(ready, plan(), jobs)) > 1) == (jobs > 1)
        assert study_rows(run_experiment(plan(), [log], jobs=jobs)).equals(whole)


def test_a_runs_states_do_not_depend_on_how_many_runs_there_are() -> None:
    log = busy_log()
    a, b = (tracks_of_run(prepare_log(log, plan(runs)), plan(runs), 3)["both"].fused for runs in (4, 12))
    for name in ("valid", "x_m", "y_m"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_adding_a_unit_or_a_configuration_changes_no_other_draw() -> None:
    log = busy_log()
    before = study_rows(run_experiment(plan(), [log]))
    units = {"new": {"on": "c1", "height_m": 1.5, "pem": "sure"}, **UNITS}
    configurations = {"first": {"units": ["new"]}, **CONFIGURATIONS, "last": {"units": "all"}}
    after = study_rows(run_experiment(plan(units=units, configurations=configurations), [log]))
    assert rows_of(after, configuration=["PEM", "both"]).equals(before)


def test_adding_or_removing_an_object_changes_no_draw_of_the_others() -> None:
    """The probabilities are constant here, so nothing but the dice could make a difference."""
    before = study_rows(run_experiment(plan(), [busy_log()]))
    for other in (busy_log(more=True), busy_log(without="p2")):
        after = study_rows(run_experiment(plan(), [other]))
        shared = sorted(set(before["object_id"]) & set(after["object_id"]))
        assert rows_of(after, object_id=shared).equals(rows_of(before, object_id=shared))


def tracks_at(fused: Tracks, log: Recording) -> dict[tuple[str, int], tuple[float, float]]:
    """(object, capture stamp) → believed position."""
    return {
        (log.scene.object_ids[o], int(fused.stamp_ns[f])): (fused.x_m[0, p], fused.y_m[0, p])
        for p, (o, f) in enumerate(zip(fused.row_object_ix, fused.frame_ix, strict=True))
        if fused.valid[0, p]
    }


def test_cropping_the_log_changes_no_draw() -> None:
    whole, cropped = busy_log(), busy_log(from_s=1.5)
    a, b = (tracks_at(tracks_of_run(prepare_log(log, plan()), plan(), 2)["PEM"].fused, log) for log in (whole, cropped))
    assert b
    assert {key: value for key, value in a.items() if key[1] >= cropped.scene.t0_ns} == b


def test_another_log_has_other_dice() -> None:
    a, b = (
        tracks_at(tracks_of_run(prepare_log(log, plan()), plan(), 2)["PEM"].fused, log)
        for log in (busy_log("a"), busy_log("b"))
    )
    assert set(a) != set(b)
    assert not set(a.values()) & set(b.values())


def test_configurations_share_their_draws() -> None:
    """The ego's unit alone, and in company: what it listed itself is in both, run by run."""
    log, both = busy_log(), plan(configurations={"PEM": {"units": ["ego"]}, "all": {"units": "all"}})
    for number in range(5):
        fused = tracks_of_run(prepare_log(log, both), both, number)
        assert set(tracks_at(fused["PEM"].fused, log)) <= set(tracks_at(fused["all"].fused, log))
