"""Which tests are slow: the table is of tests that there are, and is written from measured time."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.conftest import SLOW
from tools.slow_tests import missing_rooms, slow_tests

ROOT = Path(__file__).parents[2]


def functions_of(path: Path) -> set[str]:
    """Names of a file's tests, of those of a class behind its name."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        inside = node.body if isinstance(node, ast.ClassDef) else [node]
        before = f"{node.name}::" if isinstance(node, ast.ClassDef) else ""
        found |= {f"{before}{one.name}" for one in inside if isinstance(one, ast.FunctionDef)}
    return found


def test_what_the_table_names_is_there() -> None:
    named: dict[str, set[str]] = {}
    for line in SLOW.read_text(encoding="utf-8").splitlines():
        path, _, function = line.split()[1].partition("::")
        named.setdefault(path, set()).add(function)
    assert {path: gone for path, of in named.items() if (gone := of - functions_of(ROOT / path))} == {}


def test_slow_are_those_beyond_the_budget_with_all_their_cases() -> None:
    """3 s for what takes .2, .7 + .9 and 1.0 s in all: the last is 2.8 s, the next would be 4.9 s."""
    lines = ["0.7 a.py::x[1]", "0.2 a.py::y", "0.9 a.py::x[2]", "1.0 a.py::z", "2.1 a.py::u[a b]", "5.0 b.py::T::v"]
    assert slow_tests(lines, 3.0) == pytest.approx({"a.py::u": 2.1, "b.py::T::v": 5.0})
    assert slow_tests(lines, 100.0) == {}


def test_a_room_that_nobody_enters_is_named() -> None:
    rooms = {str(path) for path in (ROOT / "copem_replay").rglob("*.py")}
    assert missing_rooms(rooms) == []
    assert missing_rooms(rooms - {str(ROOT / "copem_replay/core/random.py")}) == ["copem_replay/core/random.py"]
