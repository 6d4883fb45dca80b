"""The tool that measures how often intervals hold: designs by hand, a short form of its table, its exit code."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

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


def test_designs_have_the_mean_that_they_claim(tool: ModuleType) -> None:
    rng = np.random.default_rng(1)
    for design in tool.DESIGNS:
        means = design.study(rng, np.full((1, 40_000), 5))[0] / 5
        assert means.mean() == pytest.approx(design.truth, abs=4 * means.std() / 200), design.name


def test_objects_of_a_log_hang_together_by_a_fifth(tool: ModuleType) -> None:
    """Of n objects with variance 1 and correlation .2 the mean has the variance .2 + .8/n."""
    rng = np.random.default_rng(2)
    for name in ("normal", "uniform", "exponential"):
        (design,) = (design for design in tool.DESIGNS if design.name == name)
        for objects in (1, 4):
            means = design.study(rng, np.full((1, 40_000), objects))[0] / objects
            assert means.var() == pytest.approx(0.2 + 0.8 / objects, rel=0.06)


def test_sizes_and_sums_by_hand(tool: ModuleType) -> None:
    w = np.array([[2, 1], [1, 3]])
    assert tool.sum_objects(np.arange(7.0), w).tolist() == [[1, 2], [3, 15]]
    rng = np.random.default_rng(3)
    assert (tool.draw_sizes(rng, 4, 3, 5, equal=True) == 5).all()
    drawn = tool.draw_sizes(rng, 4000, 3, 30, equal=False)
    assert drawn.min() >= 1
    assert np.median(drawn) == pytest.approx(30, abs=2)


def test_the_restricted_mean_is_that_of_very_many_logs(tool: ModuleType) -> None:
    """Of 200,000 logs of one object, most of whose times are known: censoring does not move the mean."""
    rng = np.random.default_rng(4)
    w = np.ones(200_000, dtype=np.int64)
    time_s, ending, _ = tool.draw_times(rng, w)
    assert (ending == tool.CENSORED).mean() == pytest.approx(1 / 6, abs=0.02)
    found = tool.restricted_mean(*tool.cumulative_incidence(time_s, ending, np.ones(len(w))), tool.HORIZON_S)
    assert found == pytest.approx(tool.true_rmst_s(), abs=0.01)


def test_no_row_of_a_short_table_is_below_its_gate(tool: ModuleType) -> None:
    table = tool.coverage((3, 8), (1, 5), studies=300)
    assert len(table) == (len(tool.DESIGNS) + 1) * 2 * 2 * 2
    assert not table["fails"].any(), table[table["fails"]]
    gated = table[table["gate"].notna()]
    assert (gated["coverage"] >= gated["gate"] - 2 * np.sqrt(gated["gate"] * (1 - gated["gate"]) / 300)).all()
    assert (table["false *"] <= 0.12).all()
    # Where one log in ten is bad, few logs without it hold nothing: named, not promised.
    seldom = table[(table["kind"] == "mean") & (table["design"] == "one bad log in ten") & (table["sizes"] == "equal")]
    assert seldom["coverage"].min() < 0.85
    assert seldom["gate"].isna().all()


def test_a_row_below_its_gate_fails(tool: ModuleType) -> None:
    low, high = np.zeros(100), np.where(np.arange(100) < 80, 2.0, 0.5)
    alike = (np.full(100, -1.0), np.ones(100))

    def row_of(gate: float | None, **held: bool) -> dict[str, object]:
        return tool.describe_row((low, high), alike, 1.0, gate, **({"judged": False, "symmetric": False} | held))

    row = row_of(0.93)
    assert (row["coverage"], row["width"], row["fails"]) == (0.8, pytest.approx(1.7), True)
    assert not row_of(0.85)["fails"]  # .85 − 2 · .0357
    assert not row_of(None)["fails"]
    # Of 100 verdicts 20 are met though the truth is beyond the bound by a hair: more than .035 + 3 · .0184.
    assert (row["wrong"], row["wrong, difference"]) == (0.2, 0.0)
    assert row_of(None, judged=True)["fails"]
    assert not row_of(None, symmetric=True)["fails"]
    shifted = tool.describe_row(alike, (low - 3.0, high - 3.0), 0.0, None, judged=True, symmetric=True)
    assert (shifted["wrong"], shifted["wrong, difference"], shifted["fails"]) == (0.0, 1.0, True)


def test_it_is_not_taken_for_the_package_of_that_name() -> None:
    """Numba imports `coverage` if there is one, and finds this file first wherever tools run."""
    code = "import numba.misc.coverage_support as of; assert not of.coverage_available or of.coverage.types"
    subprocess.run([sys.executable, "-c", code], cwd=PATH.parent, check=True)


def test_it_prints_its_tables_and_tells_by_its_exit_code() -> None:
    asked = ["--studies", "60", "--logs", "4", "--objects", "5"]
    printed = subprocess.run([sys.executable, str(PATH), *asked], capture_output=True, text=True)
    lines = printed.stdout.splitlines()
    head = "kind design objects sizes logs coverage width false * wrong wrong, difference gate"
    assert lines[0].split() == head.split()
    (verdict,) = (line for line in lines if "beyond a gate" in line)
    assert printed.returncode == int(not verdict.startswith("0 of "))
