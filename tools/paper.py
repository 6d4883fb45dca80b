"""The paper's success table, and ours beside it.

    python tools/paper.py out/tc016d

Source of the counts: Piazzoni, Cherian, Vijay, Chau, Dauwels, "CoPEM: Cooperative Perception Error Models for
Autonomous Driving", ITSC 2022 (arXiv 2211.11175), occlusion experiment: runs passed of 500 per configuration.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from statistics import NormalDist
from typing import Final

import pandas as pd

from copem_replay.metrics.summary import format_table

RUNS: Final = 500
PASSED: Final = {"GT": 500, "PEM": 426, "coPEM:0s": 499, "coPEM:0.5s": 474, "coPEM:1s": 323, "coPEM:1.5s": 0}


def wilson_limits(successes: int, n: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Bound the probability of success given `successes` of `n` independent trials: (low, high), shares.

    All p for which |successes/n − p| ≤ z·√(p(1 − p)/n), z the two-sided normal quantile. Low is exactly 0
    without a success, high exactly 1 without a failure.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    J. Amer. Statist. Assoc. 22 (1927) 209–212.
    """
    z = -NormalDist().inv_cdf((1.0 - confidence) / 2)
    share, z2 = successes / n, z * z
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = z * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    # At the ends the root of the equation is 0 or 1; the difference of two rounded terms need not be.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return low, high


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
