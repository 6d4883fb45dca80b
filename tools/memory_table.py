"""How long an object stays unknown, by list rate, without memory and with it.

Printed for docs/guide/perception-models.md.

    python tools/memory_table.py

A mast beside the crossing of logs/tc016d.mcap detects each pedestrian with probability .3 in each list, whatever hides
him; how probably is he still unknown 1 s after the onset? Then thirty lists at 10 Hz in which that probability rises.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

import copem_replay as cr
from copem_replay.metrics.exact_survival import log_sequence

P, TAU_S, AFTER_S, RUNS = 0.3, 1.0, 1.0, 4000
RATES_HZ = (5, 10, 20, 50)
LOG = Path(__file__).parents[1] / "logs/tc016d.mcap"


def main() -> None:
    print("| lists per second | without memory | the same, 4000 runs | held, 1 s | the same, 4000 runs |")
    print("|---|---|---|---|---|")
    for rate_hz in RATES_HZ:
        print(f"| {rate_hz} | {' | '.join(cell for lasts in (False, True) for cell in unknown(rate_hz, lasts))} |")
    limit = (1 - P) * math.exp(-P * AFTER_S / TAU_S)
    print(f"| without end | 0 | | {limit:.3f} = (1 − p) e^(−p t / τ) | |")
    print()
    print("| thirty lists at 10 Hz, p rising evenly from 0 to .55 | probability that none detects the object |")
    print("|---|---|")
    for said, share in (
        ("all lists are drawn anew", 0.0),
        ("60 % of the lists use a number held for .8 s", 0.6),
        ("all lists use it", 1.0),
    ):
        print(f"| {said} | {never(share):.5f} |")


def unknown(rate_hz: float, lasts: bool) -> tuple[str, str]:
    """P(T > 1 s): exact, and sampled."""
    couples = [{"detection": {"kind": "constant", "probability": P}}]
    memory = {"detection": [{"share": 1.0, "correlation_s": TAU_S}]}
    result = cr.run(
        {
            "version": 1,
            "runs": RUNS,
            "pems": {"p": {"couples": couples, "memory": memory} if lasts else couples},
            "units": {"mast": {"at": [0.0, -9.0], "height_m": 5.0, "pem": "p", "rate_hz": rate_hz}},
            "configurations": {"mast": {"units": "all"}},
            "measure": {
                "objects": {"classes": ["pedestrian"]},
                "onset": {"kind": "at", "time_s": 2.0},
                "exact": True,
                "accuracy": False,
            },
            "show": {"run": None},
        },
        LOG,
    )
    assert result.exact is not None
    until_s = 2.0 + AFTER_S + 1e-6
    known = result.exact.loc[result.exact["detection_s"] <= until_s, "probability"].sum()
    exact = 1 - known / result.exact["object_id"].nunique()
    sampled = 1 - (result.detections["detection_s"] <= until_s).mean()
    return f"{exact:.4f}", f"{sampled:.4f}"


def never(share: float) -> float:
    """P(no hit in thirty lists), of whose draws a share is held for .8 s on average."""
    p, gap_s = np.linspace(0, 0.55, 30), np.append(0.0, np.full(29, 0.1))
    return math.exp(log_sequence(p, np.zeros(30, dtype=bool), gap_s, np.full(30, share), 0.8).sum())


if __name__ == "__main__":
    main()
