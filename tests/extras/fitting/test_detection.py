"""Detection tables: EM against L-BFGS, monotone regression against a QP, intervals, the choice, what is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy.optimize import minimize
from scipy.stats import beta, t

from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import strip_comments
from copem_replay.extras.fitting.detection import DetectionFit, build_common_sequences, fit_detection
from copem_replay.extras.fitting.rows import FitRows, choose_nodes, pool_rows, weigh_nodes
from copem_replay.extras.fitting.tables import estimate_nodes, fit_em, fit_table, monotone_tables
from copem_replay.perception.pem.condition import find_couples
from copem_replay.perception.pem.model import Pem
from tests.extras.fitting.detection_rows import held_uniforms, passes, rows_of, view_of
from tools import check_fit

monotone_tables = njit(monotone_tables)  # as kernels call it

AXES = np.array([0.0, 20.0, 60.0]), np.array([0.0, 0.5, 1.0])


def bilinear(view: Any) -> np.ndarray:
    result: np.ndarray = 0.9 - 0.7 * view.range_m / 60 * (1.2 - view.visible_share)
    return result


def flat(view: Any) -> np.ndarray:
    return np.full(len(view.range_m), 0.8)


def fitted(rows: FitRows, **how: Any) -> DetectionFit:
    return fit_detection(rows, **how)


def nodes(fit: DetectionFit) -> tuple[Any, list[Any]]:
    """The nodes of the first couple as a view, and what is said of each."""
    couple = fit.couples[0]
    grid = np.meshgrid(couple.range_m, couple.visible_share, indexing="ij")
    return view_of(*(axis.ravel() for axis in grid)), [one for row in couple.probability for one in row]


def test_em_against_lbfgs() -> None:
    """4,000 rows: the same probabilities to four digits, the same penalised likelihood."""
    rows = passes(0, 40, 100, bilinear)
    where = weigh_nodes(AXES, (rows.view.range_m, rows.view.visible_share), np.zeros(4000, dtype=int))
    prior = np.full((2, 9), 0.5)
    every = np.ones(4000)
    ours, _ = fit_em(np.full(9, 0.5), where.node, where.weight, rows.listed, every, prior, np.array(where.shape), False)

    def unlikely(theta: np.ndarray) -> tuple[float, np.ndarray]:
        p = where.chances(theta)
        value = np.log(np.where(rows.listed, p, 1 - p)).sum() + (prior[0] * np.log(theta * (1 - theta))).sum()
        slope = 0.5 / theta - 0.5 / (1 - theta)
        np.add.at(slope, where.node, where.weight * np.where(rows.listed, 1 / p, -1 / (1 - p))[:, None])
        return -value, -slope

    options = {"ftol": 1e-15, "gtol": 1e-7, "maxiter": 5000}
    theirs = minimize(unlikely, np.full(9, 0.5), jac=True, bounds=[(1e-6, 1 - 1e-6)] * 9, options=options)
    np.testing.assert_allclose(ours, theirs.x, atol=1e-4)
    assert unlikely(ours)[0] == pytest.approx(theirs.fun, abs=1e-5)


def test_rows_put_together_give_nearly_the_same() -> None:
    rows = passes(1, 200, 100, bilinear)
    where = weigh_nodes(AXES, (rows.view.range_m, rows.view.visible_share), np.zeros(20_000, dtype=int))
    together = pool_rows(where, rows.listed, rows.pass_ix)
    assert len(together.hit) < 2000
    assert together.count.sum() == 20_000
    fit = fit_table(together, np.ones(200), 1.0, monotone=False)
    parent = np.full(9, (rows.listed.sum() + 0.5) / 20_001)
    prior, shape = fit.strength[0] * np.stack([parent, 1 - parent]), np.array(where.shape)
    exact, _ = fit_em(parent, where.node, where.weight, rows.listed, np.ones(20_000), prior, shape, False)
    np.testing.assert_allclose(fit.theta, exact, atol=2e-3)


@given(
    cells=st.lists(st.tuples(st.integers(0, 8), st.integers(1, 5)), min_size=12, max_size=12),
    shape=st.sampled_from([(3, 4), (6, 2), (12, 1), (1, 12)]),
)
def test_monotone_against_a_quadratic_program(cells: list[tuple[int, int]], shape: tuple[int, int]) -> None:
    """Nearest in weighted squares of all tables that fall with range and rise with visible share. Oracle: SLSQP."""
    value, weight = (np.array(column, dtype=float) for column in zip(*cells, strict=True))
    ours = monotone_tables(value, weight, np.array([1, *shape])).reshape(shape)
    assert (np.diff(ours, axis=0) <= 1e-8).all()
    assert (np.diff(ours, axis=1) >= -1e-8).all()
    number = np.arange(12).reshape(shape)
    pairs = np.concatenate(
        [
            np.stack([number[1:], number[:-1]], -1).reshape(-1, 2),
            np.stack([number[:, :-1], number[:, 1:]], -1).reshape(-1, 2),
        ]
    )
    slopes = np.zeros((len(pairs), 12))
    slopes[np.arange(len(pairs)), pairs[:, 0]], slopes[np.arange(len(pairs)), pairs[:, 1]] = -1.0, 1.0
    theirs = minimize(
        lambda x: (weight * (x - value) ** 2).sum() / 2, np.full(12, np.average(value, weights=weight)),
        jac=lambda x: weight * (x - value), method="SLSQP", options={"ftol": 1e-12, "maxiter": 500},
        constraints={"type": "ineq", "fun": lambda x: slopes @ x, "jac": lambda x: slopes},
    )  # fmt: skip
    np.testing.assert_allclose(ours.ravel(), theirs.x, atol=2e-4)


def test_nodes() -> None:
    """At quantiles; where a value is frequent at it; ends stay; fewer where rows are few, one where there are none."""
    even = np.linspace(0, 60, 601)
    np.testing.assert_allclose(choose_nodes(even, 4, 20, 1), [0, 20, 40, 60])
    np.testing.assert_allclose(choose_nodes(even, 4, 200, 1), [0, 60])
    np.testing.assert_allclose(choose_nodes(even, 4, 400, 1), [0])
    share = np.concatenate([np.ones(500), np.zeros(300), np.linspace(0.1, 0.9, 200)])
    np.testing.assert_allclose(choose_nodes(share, 4, 20, 2), [0, 0.1, 0.9, 1])


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "length", "memory"), [(30, 50, (0.6, 0.8)), (12, 100, (0.6, 0.8)), (24, 40, (0.0, 1.0))]
)
def test_intervals_hold_the_probabilities(count: int, length: int, memory: tuple[float, float]) -> None:
    """Seven seeds, all nodes of the fitted table: at least 88 of 100 (95 are meant; nodes of a table hang together)."""
    inside = []
    for seed in range(7):
        fit = fitted(passes(seed, count, length, bilinear, memory))
        view, found = nodes(fit)
        if len(fit.couples[0].visible_share) > 1:
            inside += [one.low <= p <= one.high for one, p in zip(found, bilinear(view).tolist(), strict=True)]
    assert len(inside) > 40
    assert np.mean(inside) >= 0.88


def test_ladder_finds_what_there_is() -> None:
    """Of what depends on both axes and lasts, all; of one constant, the constant; `simplest` forces it."""
    rows = passes(0, 60, 80, bilinear, (0.7, 1.0))
    fit = fitted(rows)
    names = [rung.name for rung in fit.ladder]
    both = "range × visible share"
    assert names == ["constant", "range", both, f"{both} + memory", f"{both} + memory of all objects"]
    assert [rung.chosen for rung in fit.ladder] == [False, False, False, True, False]
    assert fit.memory is not None
    assert fit.memory.share.value == pytest.approx(0.7, abs=0.1)
    assert fit.memory_why is None
    constant = fitted(passes(0, 60, 80, flat))
    assert constant.ladder[0].chosen
    assert constant.memory is None
    assert constant.memory_why == "hits and misses do not refuse that every list is new"
    forced = fitted(rows, simplest=True)
    assert forced.ladder[0].chosen
    assert forced.memory is None


def test_farther_and_more_hidden_is_never_better() -> None:
    rows = passes(3, 20, 40, lambda view: 0.5 + 0 * view.range_m + 0.3 * np.sin(view.range_m))
    for monotone in (True, False):
        where = weigh_nodes(AXES, (rows.view.range_m, rows.view.visible_share), np.zeros(800, dtype=int))
        table = fit_table(pool_rows(where, rows.listed, rows.pass_ix), np.ones(20), 1.0, monotone=monotone)
        grid = table.theta.reshape(3, 3)
        falls = (np.diff(grid, axis=0) < 1e-8).all() and (np.diff(grid, axis=1) > -1e-8).all()
        assert falls == monotone


def test_classes_and_sectors() -> None:
    """Pedestrians are listed half as often, and to the left less: each its own couple, as replayed."""
    car, pedestrian = CLASSES.index("car"), CLASSES.index("pedestrian")
    rows = passes(0, 80, 60, flat)
    kind = np.where(rows.pass_ix % 2 == 0, car, pedestrian).astype(np.int8)
    azimuth = np.linspace(-1.5, 1.5, 4800)[np.random.default_rng(1).permutation(4800)]
    p = np.where(kind == car, 0.9, 0.45) - 0.25 * (azimuth > 0)
    rows = replace(
        rows,
        view=replace(rows.view, class_ix=kind, azimuth_rad=azimuth),
        listed=np.random.default_rng(0).random(4800) < p,
    )
    fit = fitted(rows, by=("range", "class", "azimuth"))
    [chosen] = [rung.name for rung in fit.ladder if rung.chosen]
    assert chosen == "class × azimuth"
    assert len(fit.couples) == 8
    assert {couple.classes for couple in fit.couples} == {("car",), ("pedestrian",)}
    np.testing.assert_allclose(fit.probability(rows.view).mean(), p.mean(), atol=0.01)
    assert np.abs(fit.probability(rows.view) - p).mean() < 0.06
    check_replayed(fit, rows)


def sides(seed: int) -> FitRows:
    """40 drives from the left to the right of the unit, or back: listed with .9 on the one side, .35 on the other."""
    rows = passes(seed, 40, 80, flat)
    across = np.tile(np.linspace(-1.5, 1.5, 80), 40) * np.where(rows.pass_ix % 2 == 0, 1, -1)
    listed = np.random.default_rng(seed + 50).random(3200) < np.where(across > 0, 0.9, 0.35)
    return replace(rows, view=replace(rows.view, azimuth_rad=across), listed=listed)


def walkers(seed: int) -> FitRows:
    """40 drives, every other a pedestrian's, who is listed .3 as often."""
    rows = passes(seed, 40, 80, flat)
    kind = np.array([CLASSES.index("car"), CLASSES.index("pedestrian")], dtype=np.int8)[rows.pass_ix % 2]
    listed = np.random.default_rng(seed + 50).random(3200) < np.where(rows.pass_ix % 2 == 0, 0.9, 0.27)
    return replace(rows, view=replace(rows.view, class_ix=kind), listed=listed)


def together(seed: int) -> FitRows:
    """Ten logs of four objects each; all that the unit sees goes by one number that is held for .8 s."""
    rows = passes(seed, 40, 80, flat)
    rng = np.random.default_rng(seed + 50)
    log = rows.pass_ix // 4
    held = np.array([held_uniforms(rng, 80, 1.0, 0.8) for _ in range(10)])
    number = rows.list.copy()
    u = np.where(rng.random(3200) < 0.8, held[log, number], rng.random(3200))
    return replace(rows, log=log, list=log * 80 + number, listed=u < 0.6)


@pytest.mark.long
@pytest.mark.parametrize(("drawn", "name"), [(walkers, "class"), (sides, "azimuth")])
def test_what_it_was_not_given_is_not_memory(drawn: Callable[[int], FitRows], name: str) -> None:
    """By range and visible share alone either looks like misses that last for seconds. One seed in twenty may fail."""
    for seed in (0, 1, 3):
        rows = drawn(seed)
        fit = fitted(rows, intervals=False)
        assert fit.memory is None
        assert [rung.name for rung in fit.ladder if rung.chosen] == [name]
        less = fitted(rows, by=("range", "visible_share"), intervals=False)
        assert less.memory is None
        [note] = [note for note in less.notes if note.startswith(f"{name}: ")]
        assert float(note.split()[1]) > 0.05
        assert note.endswith("nats per list, but --by does not name it")


@pytest.mark.long
def test_misses_of_all_objects_at_once_are_the_units() -> None:
    held = []
    for seed in range(6):
        fit = fitted(together(seed))
        assert fit.memory is not None
        assert fit.memory.common
        held += [fit.memory.share.low <= 0.8 <= fit.memory.share.high]
        held += [fit.memory.correlation_s.low <= 0.8 <= fit.memory.correlation_s.high]
        [part] = strip_comments(fit.memory_keys()["detection"])
        assert part["of"] == "unit"
        names = {rung.name: rung.below for rung in fit.ladder}
        assert names["constant + memory"] > 0.05
    assert sum(held) >= 10
    own = fitted(passes(0, 40, 80, flat, (0.8, 0.8)))
    assert own.memory is not None
    assert not own.memory.common
    assert "of" not in own.memory_keys()["detection"][0]


@pytest.mark.long
def test_few_numbers_of_all_objects_leave_the_probability_open() -> None:
    """A number held for 5 s is a few in a drive: given the probability that these show, half of the intervals miss."""
    held = []
    for seed in range(10):
        rows, _ = check_fit.drawn_rows(check_fit.CASES["misses of all"], seed)
        memory = fit_detection(rows).memory
        assert memory is not None
        held.append(memory.share.low <= 0.7 <= memory.share.high)
    assert sum(held) >= 9


def test_a_number_of_all_objects_by_hand() -> None:
    """Two objects of one list at p ½ and ¼ that share a number: both listed with ¼, the second alone never."""
    view = view_of(np.ones(2), np.ones(2))
    for listed, expected in (([True, True], 0.25), ([True, False], 0.25), ([False, False], 0.5)):
        rows = replace(rows_of(np.arange(2), np.array(listed), view), list=np.zeros(2, dtype=int))
        found = build_common_sequences(rows, np.array([0.5, 0.25]))
        p = np.sort(np.unique(found.listed))
        inside = {(True, True): p[0], (True, False): p[1] - p[0], (False, False): 1 - p[1]}[tuple(listed)]
        assert np.exp(found.log_probability(1.0, 1.0).sum()) == pytest.approx(inside)
        assert inside == pytest.approx(expected, abs=0.02)


def written(fit: DetectionFit) -> Pem:
    """The PEM of a fit of detection alone."""
    couples = [({"when": one.when} if one.when else {}) | {"detection": one.model()} for one in fit.couples]
    return Pem.model_validate(strip_comments({"couples": couples, "memory": fit.memory_keys()}))


def check_replayed(fit: DetectionFit, rows: FitRows) -> None:
    """The PEM that is written says what the fit says."""
    pem = written(fit)
    chosen = find_couples(pem.couples, rows.view)
    assert (chosen >= 0).all()
    for c, couple in enumerate(pem.couples):
        mine = np.flatnonzero(chosen == c)
        view = rows.view.take(mine)
        np.testing.assert_allclose(couple.detection.probability(view), fit.probability(view), atol=1.1e-4)


@pytest.mark.parametrize("probability", [bilinear, flat])
def test_what_is_written_is_what_is_fitted(probability: Callable[[Any], np.ndarray]) -> None:
    rows = passes(2, 60, 60, probability, (0.8, 1.0))
    fit = fitted(rows)
    check_replayed(fit, rows)
    (part,) = written(fit).memory["detection"]
    assert fit.memory is not None
    assert part.share == pytest.approx(fit.memory.share.value, abs=1e-3)


def test_without_a_miss() -> None:
    """161 lists of one pass: (161 + ½) / 162, never 1, and no memory."""
    rows = rows_of(np.zeros(161, dtype=int), np.ones(161, dtype=bool), view_of(np.linspace(5, 50, 161), np.ones(161)))
    fit = fitted(rows)
    _, (one,) = nodes(fit)
    assert one.value == pytest.approx(161.5 / 162)
    assert one.n == 161
    assert 0.97 < one.low < one.value < one.high < 1
    assert fit.memory_why == "no miss in 161 lists"
    assert fit.ladder[0].by == "BIC"
    assert fit.notes == (
        "no miss in 161 lists: intervals of detection take lists as independent, which cannot be told",
    )
    none = fitted(replace(rows, listed=~rows.listed))
    assert none.memory_why == "no hit in 161 lists"
    assert strip_comments(none.couples[0].model())["probability"] == pytest.approx(0.5 / 162, abs=1e-4)


def test_few_passes() -> None:
    """Two: chosen by BIC on effective rows, no memory, and wider intervals than as many independent rows have."""
    rows = passes(0, 2, 160, bilinear, (0.8, 1.0))
    fit = fitted(rows)
    assert fit.ladder[0].by == "BIC"
    assert fit.memory_why == "2 passes: no correlation time of detection can be told"
    assert fit.rows_per_effective > 3
    _, found = nodes(fit)
    assert all(one.n_effective < one.n / 3 for one in found)


def test_an_interval_is_no_narrower_than_whole_passes_tell() -> None:
    """Ten passes of hits alone and ten of misses: of 1,000 rows that are taken as independent 19 count, by t fewer."""
    pass_ix, listed = np.repeat(np.arange(20), 50), np.repeat(np.arange(20) % 2 == 0, 50)
    rows = weigh_nodes((np.zeros(1), np.zeros(1)), (np.zeros(1000), np.zeros(1000)), np.zeros(1000, dtype=int))
    entries = pool_rows(rows, listed, pass_ix)
    (one,) = estimate_nodes(entries, rows, fit_table(entries, np.ones(20), 1.0, monotone=True))
    effective = 19 * (t.ppf(0.975, 999) / t.ppf(0.975, 19)) ** 2
    assert (one.value, one.n, one.n_effective) == pytest.approx((0.5, 1000, effective), rel=0.003)
    assert (one.low, one.high) == pytest.approx(
        beta.ppf([0.025, 0.975], effective / 2 + 0.5, effective / 2 + 0.5), abs=1e-3
    )
    alike = pool_rows(rows, np.arange(1000) % 2 == 0, pass_ix)
    (one,) = estimate_nodes(alike, rows, fit_table(alike, np.ones(20), 1.0, monotone=True))
    assert one.n_effective == 1000


def test_same_numbers_every_time() -> None:
    rows = passes(0, 12, 40, bilinear)
    assert repr(fitted(rows)) == repr(fitted(rows))
