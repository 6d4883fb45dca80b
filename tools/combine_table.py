"""How honest and how accurate each fusion is where errors hang together; printed for docs/guide/which-fusion.md.

copem-replay run logs/crossing_memory.yaml --out out/crossing_memory
python tools/combine_table.py out/crossing_memory
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

COLUMNS = {
    "position_rmse_m": ("RMSE, m", ".3f"), "nees": ("NEES", ".2f"), "": ("claims", ""),
    "false_positives_per_min": ("ghosts/min", ".1f"), "stale_false_positives_per_min": ("stale/min", ".1f"),
    "duplicates_per_min": ("twice/min", ".1f"), "identity_switches": ("id switches", ".2f"),
}  # fmt: skip
"""Of the summary, what stands over them, and how they are written."""


def main(folder: Path) -> None:
    print(f"{'':<22}" + "".join(f"{head:>12}" for head, _ in COLUMNS.values()))
    for _, row in pd.read_csv(folder / "summary.csv").iterrows():
        honest = (
            "too sure" if row["nees"] > row["nees_high"] else "careful" if row["nees"] < row["nees_low"] else "honest"
        )
        row[""] = honest
        cells = [f"{row[name]:{form}}" if pd.notna(row[name]) else "–" for name, (_, form) in COLUMNS.items()]
        print(f"{row['configuration']:<22}" + "".join(f"{cell:>12}" for cell in cells))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
