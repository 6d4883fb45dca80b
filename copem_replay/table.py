"""Tables as plain text: nothing wrapped, nothing cut off, for terminals and pipes alike."""

from __future__ import annotations

import pandas as pd


def as_text(table: pd.DataFrame) -> str:
    """A table with aligned columns; numbers to four significant digits, nulls as a dash."""
    cells = [[_cell(value) for value in row] for row in table.itertuples(index=False)]
    columns = list(zip(list(table.columns), *cells, strict=True))
    widths = [max(len(text) for text in column) for column in columns]
    left = [not pd.api.types.is_numeric_dtype(table[name]) for name in table.columns]
    lines = []
    for row in zip(*columns, strict=True):
        aligned = [
            text.ljust(width) if to_left else text.rjust(width)
            for text, width, to_left in zip(row, widths, left, strict=True)
        ]
        lines.append("  ".join(aligned).rstrip())
    return "\n".join(lines)


def _cell(value: object) -> str:
    if value is None or value is pd.NA or value != value:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
