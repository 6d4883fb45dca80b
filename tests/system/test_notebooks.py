"""The notebooks run, and what they show is what they print and draw."""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from run_notebooks import NOTEBOOKS, executed, printed


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_prints_what_it_shows(path: Path) -> None:
    kept = nbformat.read(path, as_version=4)
    nbformat.validate(kept)
    found = printed(executed(path))
    assert found == printed(kept)
    assert any("image/png" in text for text in found)


def test_there_are_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["01_the_paper", "02_your_own_fusion", "03_reading_the_results"]
