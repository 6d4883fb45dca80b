"""Kill workers, and commands that have workers, at random moments, and look at what is left.

    python tools/kill_crew.py --kills 20

First so many workers of `--cluster local:2`: the results are the same bytes, each time. Then so many commands, as
`kill -9` does, when a random number of pieces is there: their workers end, and the same command computes what was
missing and nothing else, to the same bytes.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOGS = 24
TOOL = [sys.executable, "-m", "copem_replay.cli.main"]


def files(out: str) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in Path(out).rglob("*") if path.is_file()}


def pieces(kept: str) -> set[str]:
    return {path.name for path in Path(kept, "pieces").rglob("[!.]*.parquet") if ".sums." not in path.name}


def kill_workers(kills: int, rng: random.Random, expected: dict[str, bytes]) -> list[str]:
    """Two workers in each study, which has pieces of its own: three may die at one log, which is then a bad one."""
    import copem_replay as cr
    from copem_replay.pipeline.crew.dask_workers import DaskWorkers
    from copem_replay.pipeline.pieces import Pieces

    wrong, killed, study = [], 0, 0
    workers = DaskWorkers("local:2", Pieces("any"), 2)
    while killed < kills:
        study += 1
        over, before = threading.Event(), killed

        def kill(over: threading.Event = over, before: int = before) -> None:
            nonlocal killed
            while killed < min(before + 2, kills) and not over.wait(rng.uniform(0.2, 3)):
                pids = sorted(n.pid for n in workers._cluster.workers.values() if n.pid)
                if pids:
                    os.kill(rng.choice(pids), signal.SIGKILL)
                    killed += 1

        thread = threading.Thread(target=kill)
        thread.start()
        try:
            cr.run("e.yaml", pieces=f"workers{study}", crew=workers).save("out", overwrite=True)
        finally:
            over.set()
            thread.join()
        if files("out") != expected:
            wrong.append(f"study {study}: other bytes after {killed} kills")
    print(f"{killed} workers killed in {study} studies, {workers.lost} deaths told, {workers.again} pieces again")
    workers.close()
    return wrong


def kill_commands(kills: int, rng: random.Random, expected: dict[str, bytes], whole: int) -> list[str]:
    wrong, unscathed, half = [], 0, 0
    for k in range(kills):
        command = [*TOOL, "run", "e.yaml", "--out", "out", "--overwrite", "--pieces", f"command{k}"]
        began = subprocess.Popen([*command, "--cluster", "local:2"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        enough = rng.randrange(whole)
        while began.poll() is None and len(pieces(f"command{k}")) <= enough:
            time.sleep(0.01)
        unscathed += began.poll() is not None
        began.kill()
        began.communicate()  # until its workers have ended, too
        there = pieces(f"command{k}")
        half += 0 < len(there) < whole
        ended = subprocess.run(command, capture_output=True, text=True)
        said = re.search(r"pieces: (\d+) computed, (\d+) found", ended.stderr)
        if said is None or (int(said[1]), int(said[2])) != (whole - len(there), len(there)):
            wrong.append(f"command {k}: {len(there)} of {whole} pieces were there, {ended.stderr.strip()}")
        if files("out") != expected:
            wrong.append(f"command {k}: other bytes")
    print(f"{kills} commands killed, {unscathed} after they had ended, {half} with some of the pieces there")
    return wrong


def main() -> None:
    sys.path.insert(0, str(ROOT))
    import copem_replay as cr
    from tests.helpers.experiments import changed, drive

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        drive(Path("0.mcap"))
        for k in range(1, LOGS):
            Path(f"{k}.mcap").hardlink_to("0.mcap")
        Path("e.yaml").write_text(changed("logs: ['*.mcap']", "runs: 300"))
        cr.run("e.yaml", pieces="plain").save("out")
        expected, whole = files("out"), len(pieces("plain"))
        wrong = kill_workers(arguments.kills, rng, expected)
        wrong += kill_commands(arguments.kills, rng, expected, whole)
        os.chdir(ROOT)
    print("\n".join([*wrong, f"wrong: {len(wrong)}"]))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
