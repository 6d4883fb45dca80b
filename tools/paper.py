"""The paper's success table, and ours beside it.

    python tools/paper.py out/tc016d

Source of the counts: Piazzoni, Cherian, Vijay, Chau, Dauwels, "CoPEM: Cooperative Perception Error Models for
Autonomous Driving", ITSC 2022 (arXiv 2211.11175), occlusion experiment: runs passed of 500 per configuration.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

import pandas as pd

from copem_replay.metrics.intervals import wilson_limits
from copem_replay.metrics.summary import format_table

RUNS: Final = 500
PASSED: Final = {"GT": 500, "PEM": 426, "coPEM:0s": 499, "coPEM:0.5s": 474, "coPEM:1s": 323, "coPEM:1.5s": 0}


def beside(summary: pd.DataFrame) -> pd.DataFrame:
    """Ours and the paper's success rates by configuration; `summary`: rows of summary.csv."""
    rows = []
    for name, passed in PASSED.items():
        ours = summary.set_index("configuration").loc[name]
        low, high = wilson_limits(passed, RUNS)
        rows.append(
            {
                "configuration": name,
                "ours, sampled": float(ours["pass_share"]),
                "ours, exact": float(ours["pass_share_exact"]),
                "paper": passed / RUNS,
                "paper 95 %": f"[{low:.4f}, {high:.4f}]",
                "exact within": "yes" if low <= ours["pass_share_exact"] <= high else "no",
            }
        )
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Our success table beside the paper's.")
    parser.add_argument("folder", type=Path, help="results of logs/tc016d.yaml")
    folder = parser.parse_args().folder
    try:
        summary = pd.read_csv(folder / "summary.csv")
    except OSError as error:
        parser.error(f"{folder}: expected a results folder: {error.strerror}")
    if not set(PASSED) <= set(summary["configuration"]) or "pass_share_exact" not in summary:
        parser.error(f"{folder}: expected the results of logs/tc016d.yaml")
    print("Success rates beside the paper's (calibrated to them: docs/reference/calibration.md)")
    print(format_table(beside(summary)))


if __name__ == "__main__":
    main()
