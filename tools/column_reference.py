"""Write the reference of the columns of a results folder: docs/reference/columns.md.

python tools/column_reference.py

Files, columns, kinds and words are those of `copem_replay/metrics/columns.py`.
"""

from __future__ import annotations

import re

from copem_replay.metrics.columns import COMPARISON, TABLES
from key_reference import ROOT, unit_of

PAGE = ROOT / "docs/reference/columns.md"
HEAD = """\
# Columns of a results folder

Made by `tools/column_reference.py` from the schema. What the files are: [results.md](../guide/results.md). Null: it
does not exist; in CSV an empty cell.
"""


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for file, table in (*TABLES.items(), ("compare --out x.csv", COMPARISON)):
        rows = [f"## `{file}`\n", f"{table.words}\n", "| column | type | unit | meaning |", "|---|---|---|---|"]
        for column in table.columns:
            unit = unit_of(re.sub(r"_(low|high|exact)$", "", column.name)) if "number" in column.kind else ""
            rows.append(f"| `{column.name}` | {column.kind} | {unit} | {column.words} |")
        parts += [*rows[:-1], rows[-1] + "\n"]
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
