"""Commands as they are typed: seconds, processor seconds and peak memory, each in a process of its own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import numpy as np
import pandas as pd

from benches import common

NAMES = """\
version: 1
logs: ["*.mcap"]
runs: 64
show: null
pems: {cam: [{detection: {kind: visible_share}}]}
units: {ego: {on: ego, height_m: 1.8, pem: cam}}
configurations: {alone: {units: [ego]}}
measure: {accuracy: false}
"""


def commands() -> Iterator[common.Line]:
    """Seconds of `--help` and `info`, seconds and peak memory of what `make demo` runs."""
    for name, words in (("help", ["--help"]), ("info", ["info", str(common.ROOT / "logs/tc016d.mcap")])):
        seconds = common.best(lambda words=words: common.spent(words), 3)
        yield {f"{name}_s": round(seconds, 3)}
    with common.scratch() as folder:
        words = ["run", str(common.ROOT / "logs/tc016d.yaml"), "--overwrite", "--out", str(folder / "out")]
        seconds = common.best(lambda: common.spent(words), 2)
        yield {"demo_s": round(seconds, 2), "demo_peak_mb": common.spent(words).peak_mb}


def reports() -> Iterator[common.Line]:
    """Seconds of `copem-replay report` on the sample (6 configurations) and the crossing (18), kilobytes of each.

    And of `report` and `plot` on 4 and 40 names of the sample's log, 70,000 rows each, with the most memory.
    """
    with common.scratch() as folder:
        for name, key in (("tc016d", "report"), ("crossing", "report_18")):
            out = folder / name
            common.spent(["run", str(common.ROOT / f"logs/{name}.yaml"), "--out", str(out)])
            seconds = common.best(lambda out=out: common.spent(["report", str(out)]), 3)
            yield {f"{key}_s": round(seconds, 2), f"{key}_kb": round((out / "report.html").stat().st_size / 1000)}
        for k in range(40):
            shutil.copy(common.ROOT / "logs/tc016d.mcap", folder / f"{k:02}.mcap")
        for names in ("0[0-3].mcap", "*.mcap"):
            text = NAMES.replace("*.mcap", names).replace("runs: 64", "runs: 5000")
            (folder / "rows.yaml").write_text(text.replace("{alone", "{late: {units: [ego], latency_s: 0.3}, alone"))
            common.spent(["run", str(folder / "rows.yaml"), "--overwrite", "--out", str(folder / "rows")])
            rows = pd.read_csv(folder / "rows/logs.csv")["rows"].sum()
            for command in ("report", "plot"):
                spent = common.spent([command, str(folder / "rows")])
                yield {f"{command}_rows": int(rows), "seconds": round(spent.seconds, 1), "peak_mb": spent.peak_mb}


def pieces() -> Iterator[common.Line]:
    """What keeping pieces costs, in CPU seconds of commands; and a finished study of 5,000 names, no log read."""
    with common.scratch() as folder:
        kept, plain, keeping = str(folder / "kept"), [], []
        command = ["run", str(common.ROOT / "logs/crossing_share.yaml"), "--overwrite", "--out", str(folder / "out")]
        for _ in range(3):
            plain.append(common.spent(command).cpu_s)
            shutil.rmtree(kept, ignore_errors=True)
            keeping.append(common.spent([*command, "--pieces", kept]).cpu_s)
        before, after = float(np.median(plain)), float(np.median(keeping))
        yield {"pieces_overhead": round(after / before - 1, 3), "seconds": round(before, 2)}
        shutil.copy(common.ROOT / "logs/tc016d.mcap", folder / "0.mcap")
        for k in range(1, 5000):
            (folder / f"{k}.mcap").hardlink_to(folder / "0.mcap")
        (folder / "names.yaml").write_text(NAMES)
        command = ["run", str(folder / "names.yaml"), "--overwrite", "--out", str(folder / "many"), "--pieces", kept]
        first, again = common.spent(command), common.spent(command)
        yield {"resume_cpu_s": round(again.cpu_s, 1), "seconds": round(again.seconds, 1), "mb": again.peak_mb,
               "first_cpu_ms_a_log": round(first.cpu_s / 5, 1), "first_mb": first.peak_mb}  # fmt: skip
