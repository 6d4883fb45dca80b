"""Whole commands against their floor: what the libraries alone need for the same bytes (`benches/parts.py`).

Command and floor run in turn, so that both have the same machine; the least of several counts. `COPEM_REPLAY_BEFORE`
names another checkout, whose command then runs in turn with both.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benches import common, parts
from copem_replay.io.write.osi import write_osi_trace
from make_logs import long_drive

DATA = common.ROOT.parent / "shared/data"
TIMES = 5
BEFORE = "COPEM_REPLAY_BEFORE"
_RUN = ("run", "e.yaml", "--overwrite", "--out", "out")


@dataclass(frozen=True)
class Job:
    """A command, in a folder that `prepare` has made ready; `reads`: the recordings that its floor reads, too."""

    name: str
    words: Sequence[str]
    prepare: Callable[[Path], None]
    reads: str = ""
    needs: str | None = None
    draws: bool = False
    goal: float | None = None

    @property
    def missing(self) -> bool:
        """Whether its recording is not there."""
        return self.needs is not None and not (data_folder() / self.needs).exists()


def data_folder() -> Path:
    """Where recorded drives are."""
    return Path(os.environ.get("COPEM_REPLAY_DATA", DATA))


def _draft(folder: Path, name: str) -> None:
    made = subprocess.run([*common.TOOL, "init", name], cwd=folder, check=True, capture_output=True, text=True)
    (folder / "e.yaml").write_text(made.stdout, encoding="utf-8")


def _drafted(name: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        shutil.copy(data_folder() / name, folder)
        _draft(folder, name)

    return prepare


def _sample(folder: Path) -> None:
    shutil.copy(common.ROOT / "logs/tc016d.mcap", folder)
    shutil.copy(common.ROOT / "logs/tc016d.yaml", folder / "e.yaml")


def _results(folder: Path) -> None:
    _sample(folder)
    common.spent(_RUN, folder)


def _city(folder: Path) -> None:
    write_osi_trace(long_drive(5, 100), folder / "city.mcap")
    _draft(folder, "city.mcap")


_DRIVE, _ROADSIDE = "nuscenes_scene0061.mcap", "msight_trial15.mcap"
JOBS = (
    Job("drive", _RUN, _drafted(_DRIVE), _DRIVE, _DRIVE, goal=1.6),
    Job("roadside", _RUN, _drafted(_ROADSIDE), _ROADSIDE, _ROADSIDE, goal=1.6),
    Job("city", _RUN, _city, "city.mcap", goal=2.0),
    Job("demo", _RUN, _sample, "tc016d.mcap"),
    Job("check", ("check", "e.yaml"), _sample, goal=1.3),
    Job("compare", ("compare", "out"), _results, goal=1.3),
    Job("report", ("report", "out"), _results, draws=True, goal=2.0),
    Job("plot", ("plot", "out"), _results, draws=True, goal=2.0),
)
"""A drive of 20 s, a roadside recording of 58 s and a city of 100 for five minutes, by the experiment of `init`; the
demo, and commands on its results. `goal`: of the ratio of processor seconds."""


def floor(names: Sequence[str] = (), times: int = TIMES) -> Iterator[common.Line]:
    """By job and part: seconds of command and floor, by processor and clock, and ratios; how often: `times`."""
    for job in JOBS:
        if names and job.name not in names:
            continue
        if job.missing:
            yield {"job": job.name, "skipped": f"no {job.needs} in {data_folder()}"}
            continue
        with common.scratch() as folder:
            yield from measure(job, folder, times)


def measure(job: Job, folder: Path, times: int) -> Iterator[common.Line]:
    """The lines of one job: of each part, and of all together."""
    here, keep = folder / "job", folder / "keep"
    here.mkdir()
    keep.mkdir()
    job.prepare(here)
    took_of("command", keep, job.words, here)  # compiles, and says what the floor has to do
    if job.words[0] == "run":
        parts.keep_messages(here / "out/replay.mcap", keep / "messages")
        parts.keep_boxes(here / "out/replay.rrd", keep / "boxes")
    elif job.draws:
        (keep / "draws.json").write_text(json.dumps(job.words))
    ways = {
        "": ("command", None, job.words, common.ROOT),
        "floor_": ("floor", keep, list(filter(None, [job.reads])), common.ROOT),
    }
    if before := os.environ.get(BEFORE):
        ways["before_"] = ("command", None, job.words, Path(before).resolve())
        took_of(*ways["before_"][:3], here, ways["before_"][3])
    found: dict[str, list[Took]] = {way: [] for way in ways}
    for _ in range(times):
        for way, (what, kept, words, root) in ways.items():
            found[way].append(took_of(what, kept, words, here, root))
    yield from lines(job, {way: least(took) for way, took in found.items()})


Took = Mapping[str, Sequence[float]]
"""Seconds of the clock and of the processor, by part; `all` is their sum."""


def took_of(what: str, keep: Path | None, words: Sequence[str], here: Path, root: Path = common.ROOT) -> Took:
    """Seconds of a process by part. Raises CalledProcessError where it fails."""
    began_s = time.perf_counter()
    command = [sys.executable, str(Path(parts.__file__)), str(began_s), what, "" if keep is None else str(keep), *words]
    environment = os.environ | {"PYTHONPATH": f"{root}", "PYTHONDONTWRITEBYTECODE": ""}
    with (here / "printed.txt").open("w+b") as printed:
        process = subprocess.Popen(command, cwd=here, env=environment, stdout=printed, stderr=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        whole_s = time.perf_counter() - began_s
        process.returncode = os.waitstatus_to_exitcode(status)
        if status:
            raise subprocess.CalledProcessError(process.returncode, command)
        printed.seek(0)
        took = {name: list(seconds) for name, seconds in json.loads(printed.read().splitlines()[-1]).items()}
    whole = whole_s, used.ru_utime + used.ru_stime
    ended = took.setdefault(parts.END, [0.0, 0.0])
    for k in (0, 1):  # what the process takes to go
        ended[k] += whole[k] - sum(seconds[k] for seconds in took.values())
    took.pop(parts.NOT_COUNTED, None)
    return took | {"all": [sum(seconds[k] for seconds in took.values()) for k in (0, 1)]}


def least(several: Sequence[Took]) -> Took:
    """Of each part the least."""
    names = list(dict.fromkeys(name for took in several for name in took))
    return {name: [min(took[name][k] for took in several if name in took) for k in (0, 1)] for name in names}


def lines(job: Job, took: Mapping[str, Took]) -> Iterator[common.Line]:
    """A line a part; a part without a floor has no ratio. `goal`, of all parts together."""
    for part in (name for name in (*ORDER, "all") if any(name in of_way for of_way in took.values())):
        line: common.Line = {"job": job.name, "part": part}
        for way, of_way in took.items():
            seconds, cpu_s = of_way.get(part, (0.0, 0.0))
            line |= {f"{way}cpu_s": round(cpu_s, 2), f"{way}s": round(seconds, 2)}
        for name, k in (("cpu_ratio", 1), ("ratio", 0)):
            least_s = took["floor_"].get(part, (0.0, 0.0))[k]
            line[name] = round(took[""].get(part, (0.0, 0.0))[k] / least_s, 2) if least_s > 0.005 else None
        yield line | {"goal": job.goal if part == "all" else None}


ORDER = (parts.START, parts.READ, parts.REPLAY, parts.TABLES, parts.MCAP, parts.RRD, parts.WORK, parts.END)
"""Parts as they come."""
