"""Does a fusion know objects sooner than the ideal of the same lists? `python tools/knows_first.py [RECORDING …]`

Each recording is replayed by the experiment that `init` writes, its units fused by the ideal and by each other fusion,
one of them the adversary that lists every entry three times. None named: those of ../shared/data. A line for each:
rows (object and run), rows that each fusion knows sooner than the ideal, and seconds unknown. The exit code is 1 where
a fusion is sooner.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

import copem_replay as cr

DATA = Path(__file__).resolve().parents[2] / "shared/data"
BASELINE = "ideal"


class Echo(cr.StepFusion):
    """The newest entries of each unit, every one three times."""

    def step(self, now_s: float, inbox: cr.Inbox, memory: Any) -> tuple[cr.Entries, Any]:
        """One list."""
        entries = np.concatenate([cr.entries_of(0), *(one.entries for one in inbox.newest)])
        entries["track_id"] = -1
        return np.repeat(entries, 3), memory


FUSIONS = {kind: kind for kind in (BASELINE, "gnn", "nms", "union", "tracker")} | {
    "echo": f"{Path(__file__).stem}:Echo"
}


def fused_by_each(recording: Path, runs: int) -> dict[str, Any]:
    """The drafted experiment with the units of its first configuration that fuses, by each fusion."""
    experiment = YAML(typ="safe").load(cr.draft_experiment(recording))
    fusing = (one for one in experiment["configurations"].values() if one.get("units") not in (None, "truth"))
    common = {key: value for key, value in next(fusing).items() if key != "fusion"}
    experiment["configurations"] = {name: common | {"fusion": {"kind": kind}} for name, kind in FUSIONS.items()}
    return experiment | {"runs": runs}


def count_sooner(experiment: dict[str, Any]) -> tuple[int, dict[str, int], dict[str, float]]:
    """Rows, those that each fusion knows sooner than the ideal, and mean seconds unknown."""
    results = cr.run(experiment)
    detection_s = results.detections.pivot_table(
        "detection_s", ["object_id", "episode", "run"], "configuration", dropna=False, observed=True
    ).fillna(np.inf)
    others = [name for name in FUSIONS if name != BASELINE]
    sooner = {name: int((detection_s[name] < detection_s[BASELINE] - 1e-9).sum()) for name in others}
    return len(detection_s), sooner, results.summary.set_index("configuration")["unknown_s"].to_dict()


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--runs", type=int, default=10)
    given = parser.parse_args()
    recordings = given.recordings or sorted(DATA.glob("*.mcap"))
    names = [name for name in FUSIONS if name != BASELINE]
    print(f"{'':34s} rows  sooner than {BASELINE}: {'/'.join(names)}  seconds unknown: {BASELINE}/{'/'.join(names)}")
    rows, sooner = 0, 0
    for recording in recordings:
        count, of, unknown_s = count_sooner(fused_by_each(recording, given.runs))
        rows, sooner = rows + count * len(names), sooner + sum(of.values())
        counts, seconds = "/".join(str(of[name]) for name in names), "/".join(f"{unknown_s[n]:.3f}" for n in FUSIONS)
        print(f"{recording.stem:34s} {count:4d}  {counts}  {seconds}", flush=True)
    print(f"{sooner} of {rows} rows of fusions are sooner than {BASELINE}")
    return 1 if sooner else 0


if __name__ == "__main__":
    sys.exit(main())
