"""The tool that measures how often intervals hold: designs by hand, and that what is reported holds."""

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


def test_designs_have_the_share_that_they_claim(tool: ModuleType) -> None:
    rng = np.random.default_rng(1)
    for design in tool.DESIGNS:
        drawn = design.draw(rng, 40_000)
        assert (drawn >= 0).all()
        assert (drawn <= 1).all()
        assert drawn.mean() == pytest.approx(design.share, abs=4 * drawn.std() / 200)


def test_percentiles_of_all_or_nothing_hold_where_a_failure_is_drawn(tool: ModuleType) -> None:
    """Five at .97: with none missed, (.97)⁵ of the trials, they are a point; with exact limits they hold."""
    design = next(design for design in tool.DESIGNS if design.name == "0/1 at 0.97")
    found = tool.held(design, "equal", 5, 400, 1)
    assert found["bootstrap holds"] == pytest.approx(1 - 0.97**5, abs=0.06)
    assert found["reported holds"] >= 0.99
    # Nothing missed: [.478, 1].
    assert found["its width"] > 0.5218


def test_what_is_reported_holds_in_every_design(tool: ModuleType) -> None:
    table = tool.coverage((5, 12), trials=300)
    assert len(table) == 2 * 6 * 2
    assert (table["reported holds"] >= 0.93).all()
    assert (table["its width"] >= table["width"]).all()
    assert tool.cost(table)["clusters"].tolist() == [5, 12, 5, 12]


def test_it_is_not_taken_for_the_package_of_that_name() -> None:
    """Numba imports `coverage` if there is one, and finds this file first wherever tools run."""
    code = "import numba.misc.coverage_support as of; assert not of.coverage_available or of.coverage.types"
    subprocess.run([sys.executable, "-c", code], cwd=PATH.parent, check=True)


def test_it_prints_its_tables() -> None:
    asked = ["--trials", "20", "--clusters", "5"]
    printed = subprocess.run(
        [sys.executable, str(PATH), *asked], check=True, capture_output=True, text=True
    ).stdout.splitlines()
    assert printed[0].split()[:3] == ["shares", "weights", "clusters"]
    assert len(printed) == 1 + 12 + 2 + 1 + 2
