"""Names in CSV files: quoted where a spreadsheet would take them for formulas, and read back as they were.

A name that begins with `=`, `+`, `-`, `@`, a tab or a line's end gets an apostrophe before it, which tells spreadsheets
that it is text; so does one that begins with an apostrophe, so that taking one away gives every name back.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pandas as pd

_QUOTE = "'"
_QUOTED = ("=", "+", "-", "@", "\t", "\r", "\n", _QUOTE)


def for_spreadsheets(table: pd.DataFrame) -> pd.DataFrame:
    """A table of which all text is quoted where it has to be. Numbers stay what they are."""
    text = [name for name, column in table.items() if not pd.api.types.is_numeric_dtype(column)]
    return table.assign(**{name: table[name].map(_quoted) for name in text})


def as_named(table: pd.DataFrame, columns: Iterable[str]) -> pd.DataFrame:
    """The same with the names in some columns as they were."""
    return table.assign(**{name: table[name].map(_unquoted) for name in columns})


def _quoted(value: Any) -> Any:
    return _QUOTE + value if isinstance(value, str) and value.startswith(_QUOTED) else value


def _unquoted(value: Any) -> Any:
    return value.removeprefix(_QUOTE) if isinstance(value, str) else value
