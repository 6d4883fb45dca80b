"""How much later objects are known by radio, at which loss, bursts and distance; printed for docs/guide/links.md.

copem-replay run logs/crossing_radio.yaml --out out/crossing_radio
python tools/links_table.py out/crossing_radio
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

AGE = "age_of_information"
COLUMNS = ("ttd_rmst_s", "ttd_median_s", "ttd_p95_s", "lost_share", f"{AGE}_p50_s", f"{AGE}_p95_s")


def main(folder: Path) -> None:
    summary, sweep = (pd.read_csv(folder / name) for name in ("summary.csv", "sweep.csv"))
    wired_s = float(summary.set_index("configuration").loc["wired", "ttd_rmst_s"])
    print(f"mean time to detection, wired: {wired_s:.3f} s")
    print(f"{'':<20}{'later by':>10}{'median':>9}{'p95':>9}{'lost':>8}{'age p50':>9}{'age p95':>9}")
    for _, row in summary.iterrows():
        line(row["configuration"], row, wired_s)
    for (kind, name), rows in sweep.groupby(["sweep", "configuration"], sort=False):
        print(f"{name}, {kind}")
        for _, row in rows.iterrows():
            line(f"  {row['value']:g}", row, wired_s)


def line(what: str, row: pd.Series, wired_s: float) -> None:
    """One row: mean time to detection as a difference to that without a link, in seconds."""
    mean, *cells = (row[name] for name in COLUMNS)
    text = [f"{cell:.3f}" if pd.notna(cell) else "–" for cell in cells]
    widths = (9, 9, 8, 9, 9)
    print(f"{what:<20}{mean - wired_s:>+8.3f} s" + "".join(f"{one:>{n}}" for one, n in zip(text, widths, strict=True)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
