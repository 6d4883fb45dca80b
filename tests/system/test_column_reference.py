"""The reference of the columns of a results folder is current, and describes every column."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from column_reference import PAGE, page, words  # noqa: E402


def test_the_page_is_what_the_tool_writes_and_every_column_is_described() -> None:
    made = page()
    assert PAGE.read_text(encoding="utf-8") == made, "python tools/column_reference.py"
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| (.*) \|$", made, re.MULTILINE)
    assert len(rows) > 150
    assert [row for row in rows if not row[3]] == []


@pytest.mark.parametrize(
    ("file", "name", "expected"),
    [
        ("accuracy.parquet", "run", "number of the run, from 0 on"),  # in every file
        ("lists.parquet", "duplicates", "entries about a measured object beside its match"),  # of this file
        ("summary.csv", "n", "rows: runs × measured objects × logs"),  # a metric's help
        ("tally.parquet", "detection_s", "when the list that confirmed it was available"),  # the guide's
        ("tally.parquet", "nobody_describes_this", ""),
    ],
)
def test_where_words_come_from(file: str, name: str, expected: str) -> None:
    assert words(file, name) == expected
