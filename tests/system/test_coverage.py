"""The tool that measures how often intervals hold: designs by hand, a short form of its table, its exit code."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import binomtest

PATH = Path(__file__).parents[2] / "tools" / "coverage.py"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("interval_coverage", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


def test_times_of_objects_have_the_mean_of_their_distribution(tool: ModuleType) -> None:
    means = {name: float(draw(tool._GRID).mean()) for name, draw in tool.OBJECTS.items()}
    assert len(means) == 62
    for name, expected in {
        "two points: 0.6, 0.1 never": 0.9 * 0.6 + 0.1 * 5,
        "three points: 0, .6, 0.2 never": 0.4 * 0.6 + 0.2 * 5,
        "normal and never: .5 ± .1, 0.02 never": 0.98 * 0.5 + 0.02 * 5,
        "beta: 2, 8": 5 * 0.2,
        "zero and a tail: .7 at 0": 0.3 * (1 - math.exp(-5)),
        "cut at the horizon: 1/u": 0.2 * (1 + math.log(25)),
        "exponential": 1 - math.exp(-5),
        "uniform": 1.0,
    }.items():
        assert means[name] == pytest.approx(expected, abs=1e-3), name


@pytest.mark.parametrize("kind", ["rare bad", "mild", "zero and a tail", "Beta 10 at 0.9"])
def test_logs_have_the_share_and_the_mean_that_they_claim(tool: ModuleType, kind: str) -> None:
    """Of one object of each of 400,000 logs."""
    rng = np.random.default_rng(1)
    logs = tool.draw_logs(kind, rng, (400_000,))
    known = rng.random(400_000) < logs.share
    time_s = np.minimum(logs.median_s * np.exp(logs.sigma * rng.normal(size=400_000)), 5.0)
    assert known.mean() == pytest.approx(logs.share.mean(), abs=0.003)
    assert np.where(known, time_s, 5.0).mean() == pytest.approx(logs.expected_s().mean(), abs=0.015)


def test_sizes_and_sums_by_hand(tool: ModuleType) -> None:
    w = np.array([[2, 1], [1, 3]])
    assert tool.sum_objects(np.arange(7.0), w).tolist() == [[1, 2], [3, 15]]
    rng, bad = np.random.default_rng(3), np.array([[True, False, False]] * 4)
    assert (tool.draw_sizes("5 each", bad, rng) == 5).all()
    assert (tool.draw_sizes("busy", bad, rng) == [25, 5, 5]).all()
    giant = tool.draw_sizes("60 among 3", bad, rng)
    assert (np.sort(giant, axis=1) == [3, 3, 60]).all()
    drawn = tool.draw_sizes("unequal", np.zeros((4000, 3), dtype=bool), rng)
    assert drawn.min() == 1
    assert np.median(drawn) == pytest.approx(6, abs=0.5)


def test_limits_of_means_are_those_of_trials(tool: ModuleType) -> None:
    values = np.array([[1.0, 0.0, 1.0, 1.0, 1.0], [0.0] * 5])
    low, high = tool.limit_means(values, np.ones((2, 5)), (0.0, 1.0))
    for k, found in ((4, 0), (0, 1)):
        expected = binomtest(k, 5).proportion_ci(0.95, method="exact")
        assert (low[found], high[found]) == pytest.approx((expected.low, expected.high))
    low, high = tool.limit_means(np.array([[1.0, 2.0, 6.0]]), np.ones((1, 3)), None)
    half = 4.302653 * math.sqrt(7 / 3)
    assert (low[0], high[0]) == pytest.approx((3 - half, 3 + half), abs=1e-5)


def test_a_row_beyond_a_gate_fails_unless_its_line_is_named(tool: ModuleType) -> None:
    """Of 2,000 studies with an interval 1,900 hold 1, 60 are below it and 40 above."""
    low, high = np.zeros(2001), np.full(2001, 2.0)
    high[:60], low[60:100], low[-1] = 0.5, 1.5, math.nan

    def row(figure: str, guide: str = "", truth: float = 1.0) -> dict[str, object]:
        return tool.Row("means", "a", figure, "logs", 3, low, high, truth).tell(guide)

    found = row("nees")
    assert (found["held"], found["of"], found["median width"]) == (1900, 2000, 2.0)
    assert (found["wrongly met"], found["wrongly not met"], found["fails"]) == (0.03, 0.02, False)
    assert row("detected_share")["wrongly met"] == 0.02
    # 2 and more is never held: beyond both gates; of a difference criteria are met by other limits.
    beyond = row("nees", truth=2.1)
    assert (beyond["held"], beyond["wrongly met"], beyond["fails"], beyond["named"]) == (0, 1.0, True, "")
    assert row("difference", truth=2.1)["fails"]
    assert row("difference, at_most", truth=2.1)["fails"]
    assert not row("difference, at_most", truth=-0.1)["fails"]
    named = row("nees", "| **means** | .1 |", truth=2.1)
    assert (named["fails"], named["named"]) == (False, "means")
    assert row("nees", "| means | .1 |", truth=2.1)["fails"]


def test_few_studies_may_miss_a_gate_by_chance(tool: ModuleType) -> None:
    assert tool.allowance(0.04, 100) == pytest.approx(2 * 0.0195959, abs=1e-6)
    low, high = np.zeros(100), np.where(np.arange(100) < 10, 0.5, 2.0)
    assert tool.Row("means", "a", "difference", "logs", 3, low, high, 1.0).tell("")["fails"] is False  # .90 + .051
    low, high = np.zeros(1000), np.where(np.arange(1000) < 100, 0.5, 2.0)
    assert tool.Row("means", "a", "difference", "logs", 3, low, high, 1.0).tell("")["fails"] is True


def test_rates_of_drives_have_the_mean_and_the_spread_that_they_claim(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Events in hours, as the limits see them: of 0.3 and 2 an hour, with their coefficient of variation."""
    seen = list[tuple[np.ndarray, np.ndarray]]()
    monkeypatch.setattr(tool, "CLUSTERS", (20,))
    monkeypatch.setattr(tool, "limit_rate", lambda *drives: seen.append(drives) or (0.0, 1.0))
    rows = list(tool.rate_rows(np.random.default_rng(2), 2000))
    assert [row.truth for row in rows] == [0.3, 2.0] * 4
    assert [row.line for row in rows[::2]] == [
        "rates, drives", "rates, drives", "rates, drives that differ", "rates, drives far apart",
    ]  # fmt: skip
    for k, row in enumerate(rows):
        events, hours = (np.concatenate([one[of] for one in seen[k * 2000 : (k + 1) * 2000]]) for of in (0, 1))
        assert hours.mean() == pytest.approx(1.0, abs=0.01)
        assert events.sum() / hours.sum() == pytest.approx(row.truth, rel=0.05)
        cv = (0.0, 0.5, 1.0, 2.0)[k // 2]
        beyond = ((events - row.truth * hours) ** 2 - events).sum() / (row.truth**2 * (hours**2).sum())
        assert beyond == pytest.approx(cv**2, abs=0.1 + 0.1 * cv**2)


def test_no_row_of_a_short_table_is_beyond_a_gate(tool: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool, "CLUSTERS", (3, 8, 20))
    monkeypatch.setattr(tool, "_MANY", 100_000)
    monkeypatch.setattr(tool, "KINDS", ("rare bad", "mild"))
    monkeypatch.setattr(tool, "BUSY", ("rare bad",))
    for name in ("FOLLOWED_OBJECTS", "FOLLOWED_LOGS"):
        designs = getattr(tool, name)
        monkeypatch.setattr(tool, name, dict(list(designs.items())[-1:]))
    table = tool.coverage(400, 1)
    assert not table["fails"].any(), table[table["fails"]]
    assert set(table["figure"]) >= {*tool.FOLLOWED, "difference", "difference, at_most", "nees"}
    assert set(table["over"]) == {"objects", "logs", "passes"}
    # Bad logs that are busy are in no sample of the few that lack them: named, not promised.
    busy = table[(table["line"] == "times, bad logs that are busy") & (table["clusters"] == 8)]
    assert (busy["held"] / busy["of"]).min() < 0.95
    assert (busy["named"] == "times, bad logs that are busy").all()
    # The page has all lines, and no other: a name that is misspelt there would name nothing.
    guide = tool.GUIDE.read_text(encoding="utf-8").splitlines()
    assert {line.split("|")[1].strip(" *") for line in guide if " · " in line and line[0] == "|"} == {
        "held · width",
        *table["line"],
    }
    lines = tool.sum_up(table)
    assert lines[0] == "| held · width | 3 | 8 | 20 | wrongly met |"
    assert any(line.startswith("| **times, bad logs that are busy** | ") for line in lines)


def test_tables_of_nothing_have_few_stars(tool: ModuleType) -> None:
    whole, named, alone = tool.star_shares(np.random.default_rng(5), "mild", "5 each", 4, 300)
    assert 0.3 < alone < 0.7
    assert whole <= 0.06
    assert len(named) == 7
    assert max(named) <= 0.06 + tool.allowance(0.06, 300)


def test_it_is_not_taken_for_the_package_of_that_name() -> None:
    """Numba imports `coverage` if there is one, and finds this file first wherever tools run."""
    code = "import numba.misc.coverage_support as of; assert not of.coverage_available or of.coverage.types"
    subprocess.run([sys.executable, "-c", code], cwd=PATH.parent, check=True)


def test_it_prints_every_row_and_tells_by_its_exit_code(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tool, "PARTS", (tool.unbounded_rows,))
    monkeypatch.setattr(tool, "NULLS", (("alike", "5 each"),))
    monkeypatch.setattr(sys, "argv", ["coverage.py", "--csv", "--studies", "50"])
    assert tool.main() == 0
    printed = capsys.readouterr()
    head, *rows = printed.out.splitlines()
    expected = "design,figure,over,clusters,held,of,wrongly met,wrongly not met,median width,named"
    assert head == expected
    assert len([row for row in rows if ",nees,logs," in row]) == len(tool.UNBOUNDED) * 3 * 7
    assert printed.err == "0 of 130 rows are beyond a gate and not named\n"
    monkeypatch.setattr(tool, "COVERAGE", 1.2)
    monkeypatch.setattr(tool, "allowance", lambda gate, n: 0.0)
    assert tool.main() == 1
    assert "rows are beyond a gate" in capsys.readouterr().err
