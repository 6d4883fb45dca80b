"""The notebooks run, and what they show is what they print and draw."""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from processor import IS_X86
from run_notebooks import NOTEBOOKS, drop_progress, executed, printed


@pytest.mark.skipif(not IS_X86, reason="notebooks are kept as x86-64 prints them: others round otherwise")
@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_prints_what_it_shows(path: Path) -> None:
    kept = nbformat.read(path, as_version=4)
    nbformat.validate(kept)
    found = printed(executed(path))
    assert found == printed(kept)
    assert any("image/png" in text for text in found)


def test_there_are_notebooks() -> None:
    names = ["01_the_paper", "02_your_own_fusion", "03_reading_the_results", "04_a_pem_from_recordings"]
    assert [path.stem for path in NOTEBOOKS] == [*names, "05_your_own_drive"]


def test_a_text_that_comes_in_pieces_is_one_text() -> None:
    def said(text: str, name: str = "stdout") -> dict[str, str]:
        return {"output_type": "stream", "name": name, "text": text}

    picture = {"output_type": "display_data", "data": {"image/png": "", "text/plain": ""}}
    cells = [[said("a"), said("\n"), said("b", "stderr"), said("c")], [said("d"), picture, said("e")]]
    notebook = nbformat.from_dict({"cells": [{"outputs": outputs} for outputs in cells]})
    assert printed(notebook) == ["a\n", "b", "c", "d", "image/png, text/plain", "e"]


def test_the_empty_line_of_progress_is_not_kept() -> None:
    """It is there where a run took more than two seconds; what is kept must not hang on that."""
    line = {"output_type": "display_data", "metadata": {}, "data": {"text/plain": ""}}
    words = {"output_type": "stream", "name": "stdout", "text": "a"}
    cells = [{"cell_type": "code", "source": "", "outputs": [line, words]}, {"cell_type": "markdown", "source": ""}]
    notebook = nbformat.from_dict({"cells": cells})
    drop_progress(notebook)
    assert notebook.cells[0].outputs == [words]
