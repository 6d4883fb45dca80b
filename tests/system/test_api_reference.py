"""The reference of the API is what its docstrings say, and has every name."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import copem_replay as cr

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from api_reference import GROUPS, PAGE, entry, page, signature

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.mark.extras
def test_the_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python tools/api_reference.py"


def test_every_name_is_on_it_once() -> None:
    names = [name for group in GROUPS.values() for name in group.split()]
    assert sorted(names) == sorted(cr.__all__)


def test_examples_are_code() -> None:
    def half(number: float, *, up: bool = False) -> int:
        """Halve it.

        >>> half(
        ...     4)
        2

        More.
        """
        return round(number / 2)

    assert signature(half) == "(number: float, *, up: bool = False) -> int"
    assert entry("half", half.__doc__ or "").splitlines() == [
        "### `half`", "", "Halve it.", "", "```python", ">>> half(", "...     4)", "2", "```", "", "More.",
    ]  # fmt: skip


def test_the_tool_writes_it(tmp_path: Path) -> None:
    place = f"__import__('pathlib').Path({str(tmp_path)!r}, 'api.md')"
    code = f"import api_reference; api_reference.PAGE = {place}; api_reference.main()"
    subprocess.run([sys.executable, "-c", code], cwd=TOOLS, check=True)
    assert (tmp_path / "api.md").read_text(encoding="utf-8") == PAGE.read_text(encoding="utf-8")
