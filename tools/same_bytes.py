"""Do two checkouts of the project write the same? `python tools/same_bytes.py BEFORE AFTER`, two folders.

A case is an experiment and the commands it goes through: the samples of each checkout, and recordings in ../shared/data
(left out where absent) by the experiment that `init` writes. All that the commands write and print has to be equal byte
by byte, .rrd by content; what may differ is listed in first_difference.py (KNOWN). A line for each case says `same` or
the first difference. The exit code is 1 where anything differs, 2 where nothing is compared or a checkout has changed
meanwhile.

`--cases`: only these; 'tc016d*' are all that begin so. `--all`: the slow ones, too. `--runs`: of each experiment [20].
`--keep FOLDER`: what was written stays there, in CASE/before and CASE/after.

`--time SAMPLE`: instead, processor seconds of `run --jobs 1` on that sample: five of each checkout in turn, after one
that compiles; medians, and after : before.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from statistics import median
from typing import Any

from ruamel.yaml import YAML

from first_difference import difference_of_folders

DATA = Path(__file__).parents[2] / "shared/data"
Command = tuple[str, ...]
_RUN: Command = ("run", "e.yaml", "--runs", "RUNS")
_COMPARE: Command = ("compare", "out", "--baseline", "PEM")
_ONE_JOB: Command = (*_RUN, "--jobs", "1", "--out", "out")
_TIMED = 5


@dataclass(frozen=True)
class Case:
    """An experiment, by the name of a sample or a recording, with `changes` merged into it; `commands` on `e.yaml`."""

    name: str
    source: str
    commands: tuple[Command, ...] = (_ONE_JOB,)
    changes: Mapping[str, Any] = field(default_factory=dict)
    slow: bool = False

    @property
    def missing(self) -> str | None:
        """Why it cannot be compared; None: it can."""
        if self.recorded is None or (DATA / self.recorded).exists():
            return None
        return f"no {self.recorded} in {DATA}"

    @property
    def recorded(self) -> str | None:
        """The recording's name where it is none of the samples."""
        return f"{self.source}.mcap" if self.source in _RECORDED else None


_RECORDED = ("nuscenes_scene0916", "av2_3b3570b4", "msight_trial14", "ind_aah1")
_MEMORY = {
    "detection": [{"share": 0.6, "correlation_s": 0.8}],
    "position": [{"share": 0.6, "correlation_s": 2.0}, {"share": 0.2, "correlation_s": "always"}],
}
_ROUGH = {
    "pems": {
        "rough": {
            "couples": [
                {
                    "when": {"range_m": [0, 70]},
                    "detection": {"kind": "constant", "probability": 0.8},
                    "error": {"kind": "gaussian", "covariance_m2": [[0.5, 0.1], [0.1, 0.4]], "speed_sigma_mps": 0.5},
                }
            ],
            "memory": _MEMORY,
            "ghosts": [
                {
                    "in_list": 0.2, "lasts_s": 1.0, "where": {"kind": "field", "range_m": [3, 60]},
                    "classes": {"pedestrian": 1.0}, "existence": 0.5,
                }
            ],
        }
    },
    "units": {"sender": {"on": "ego", "height_m": 1.8, "pem": "rough", "rate_hz": 7, "phase_s": 0.02}},
    "links": {
        "radio": {
            "latency": {"kind": "gamma", "min_s": 0.02, "mean_s": 0.06, "shape": 2},
            "reception": {"kind": "gilbert_elliott", "bad_share": 0.3, "bad_lasts_s": 1.0},
        }
    },
    "configurations": {
        f"{kind}:radio": {"units": "all", "link": "radio", "issue_hz": 10, "fusion": {"kind": kind}}
        for kind in ("ideal", "union", "nms", "gnn", "tracker")
    },
}  # fmt: skip
"""What an experiment by `init` has not: memory, false entries, a link with losses, each fusion."""
_TIMES_ALONE = {"measure": {"exact": True, "accuracy": False}}


def _modes(source: str, *, slow: bool = False) -> tuple[Case, ...]:
    """The ways to compute one experiment; pieces are kept, and taken up by a second run."""
    kept = (*_RUN, "--jobs", "2", "--pieces", "kept.pieces", "--out")
    return (
        Case(f"{source}:jobs4", source, ((*_RUN, "--jobs", "4", "--out", "out"),), slow=slow),
        Case(f"{source}:pieces", source, ((*kept, "out"), (*kept, "again")), slow=slow),
        Case(f"{source}:cluster", source, ((*_RUN, "--cluster", "local:2", "--out", "out"),), slow=slow),
    )


_OF_COMMANDS: tuple[Command, ...] = (
    ("schema",),
    ("check", "e.yaml"),
    ("info", "tc016d.mcap", "crossing.mcap"),
    ("info", "--json", "tc016d.mcap"),
)
_OF_RESULTS: tuple[Command, ...] = (
    (*_ONE_JOB, "--report"),
    _COMPARE,
    (*_COMPARE, "--out", "c.csv"),
    ("plot", "out"),
    ("layout", "out"),
)
_FIT: Command = ("fit", "e.yaml", "--unit", "rsu", "--out", "fit")
_EXACT_DRIVE = _TIMES_ALONE | {  # gnn, of the draft, has no exact times
    "configurations": {"gnn": {"units": "all"}, "alone": {"units": ["ego"]}, "late": {"units": "all", "latency_s": 0.5}}
}
_PLACED = {
    "units": {
        "rsu": {
            "at": [13.1, 73.9], "yaw_deg": -135, "height_m": 6.0,
            "recorded": {
                "topic": "mcity.RSU.SensorData", "delay_s": 0.219, "covariance_m2": [[0.5, 0.0], [0.0, 0.5]],
            },
        }
    }
}  # fmt: skip
"""A place for the recorded unit, of which the recording says nothing; it only has to be one."""

CASES = (
    Case("words", "tc016d", _OF_COMMANDS),
    Case("tc016d", "tc016d", _OF_RESULTS),
    *(
        Case(name, name)
        for name in (
            "tc016d_beyond",
            "crossing_radio",
            "crossing_share",
            "crossing_units",
            "crossing_wall",
            "crossing_map",
        )
    ),
    *(Case(name, name) for name in _RECORDED),
    *_modes("tc016d"),
    *_modes("crossing_radio"),
    *_modes("nuscenes_scene0916"),
    Case("nuscenes_scene0916:rough", "nuscenes_scene0916", changes=_ROUGH),
    Case("av2_3b3570b4:rough", "av2_3b3570b4", changes=_ROUGH),
    Case("av2_3b3570b4:exact", "av2_3b3570b4", changes=_EXACT_DRIVE),
    Case("crossing_units:exact", "crossing_units", changes=_TIMES_ALONE),
    Case("msight_trial14:fit", "msight_trial14", (_FIT,), _PLACED),
    Case("crossing", "crossing", (_ONE_JOB, ("compare", "out"))),
    Case("crossing_memory", "crossing_memory"),
    *_modes("crossing_share", slow=True),
    *_modes("crossing", slow=True),
    *_modes("crossing_memory", slow=True),
)


class Checkout:
    """A folder with the project: its command, in a process of its own, on files in a folder elsewhere."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        try:
            project = tomllib.loads((self.folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
            module, _, function = project["scripts"]["copem-replay"].partition(":")
        except (OSError, KeyError) as found:
            expected = f"{folder}: expected a checkout of the project, found no pyproject.toml of it"
            raise SystemExit(f"{expected} ({found})") from None
        self.code = f"import sys; from {module} import {function}; sys.argv[0] = 'copem-replay'; sys.exit({function}())"
        self.environment = {**os.environ, "PYTHONPATH": str(self.folder), "RERUN_ANALYTICS": "0", "COLUMNS": "200"}
        found = self.python("import copem_replay; print(copem_replay.__file__)").strip()
        if not Path(found).is_relative_to(self.folder):
            raise SystemExit(f"{folder}: expected its own package to be imported, found {found}")

    def digest(self) -> str:
        """Of the package's files, as they are now."""
        files = sorted(path for path in (self.folder / "copem_replay").rglob("*.py"))
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()

    def python(self, code: str) -> str:
        """What a line of Python prints."""
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, env=self.environment, cwd=self.folder, check=True, capture_output=True, text=True
        ).stdout

    def call(self, arguments: Sequence[str], here: Path) -> subprocess.CompletedProcess[str]:
        """The project's command, in a folder."""
        command = [sys.executable, "-c", self.code, *arguments]
        return subprocess.run(command, cwd=here, env=self.environment, capture_output=True, text=True, check=False)

    def prepare(self, case: Case, here: Path) -> None:
        """The experiment as `e.yaml` in a folder, its recording beside it: no path outside is in any file."""
        here.mkdir(parents=True)
        if case.recorded is None:
            for path in (self.folder / "logs").iterdir():
                if path.suffix in (".mcap", ".xodr"):
                    shutil.copy(path, here)
            text = (self.folder / f"logs/{case.source}.yaml").read_text(encoding="utf-8")
        else:
            shutil.copy(DATA / case.recorded, here)
            made = self.call(["init", case.recorded], here)
            text = made.stdout
            (here / "init.txt").write_text(f"{made.stderr}exit code {made.returncode}\n")
        if case.changes:
            _write_merged(text, case.changes, here / "e.yaml")
        else:
            (here / "e.yaml").write_text(text, encoding="utf-8")

    def carry_out(self, case: Case, runs: int, here: Path) -> str | None:
        """Its commands, one after the other; what they print stands in files of its own. Why one failed, if one did."""
        self.prepare(case, here)
        for number, words in enumerate(_with_runs(command, runs) for command in case.commands):
            done = self.call(words, here)
            printed = f"{done.stdout}\n--- stderr\n{done.stderr}\nexit code {done.returncode}\n"
            (here / f"printed_{number}_{words[0]}.txt").write_text(printed, encoding="utf-8")
            if done.returncode not in (0, 1) or (done.returncode == 1 and words[0] != "fit"):
                return f"`{' '.join(words)}` ended with {done.returncode}: {done.stderr.strip()[-300:]}"
        return None


def _with_runs(command: Command, runs: int) -> list[str]:
    return [str(runs) if word == "RUNS" else word for word in command]


def _write_merged(text: str, changes: Mapping[str, Any], path: Path) -> None:
    yaml = YAML()
    data = yaml.load(text)
    for section, keys in changes.items():
        data[section] = {**(data.get(section) or {}), **keys}
    with path.open("w", encoding="utf-8") as file:
        yaml.dump(data, file)


def compared(case: Case, sides: Sequence[Checkout], runs: int, folder: Path) -> str | None:
    """Both checkouts at once; the first difference, if there is one."""
    places = [folder / "before", folder / "after"]
    with ThreadPoolExecutor(len(sides)) as pool:
        failed = list(pool.map(lambda each: each[0].carry_out(case, runs, each[1]), zip(sides, places, strict=True)))
    for place, why in zip(places, failed, strict=True):
        if why is not None:
            return f"{place.name}: {why}"
    return difference_of_folders(*places)


def compare_all(cases: Sequence[Case], sides: Sequence[Checkout], runs: int, keep: Path | None) -> int:
    """A line for each, and counts; the exit code."""
    counts = dict.fromkeys(("same", "different", "left out"), 0)
    began_s, digests = time.perf_counter(), [side.digest() for side in sides]
    with tempfile.TemporaryDirectory() if keep is None else nullcontext(keep) as scratch:
        for case in cases:
            case_began_s, folder = time.perf_counter(), Path(scratch) / case.name.replace(":", "_")
            if (why := case.missing) is not None:
                counts["left out"] += 1
                print(f"{case.name:26} left out: {why}", flush=True)
                continue
            shutil.rmtree(folder, ignore_errors=True)
            found = compared(case, sides, runs, folder)
            counts["same" if found is None else "different"] += 1
            print(f"{case.name:26} {found or 'same'}  [{time.perf_counter() - case_began_s:.0f} s]", flush=True)
            if keep is None:
                shutil.rmtree(folder)
    told = ", ".join(f"{number} {what}" for what, number in counts.items())
    print(f"{told}; {time.perf_counter() - began_s:.0f} s")
    if changed := [str(side.folder) for side, was in zip(sides, digests, strict=True) if side.digest() != was]:
        print(f"changed meanwhile: {', '.join(changed)}; compare again")
        return 2
    return 1 if counts["different"] else 0 if counts["same"] else 2


def time_sample(sample: str, sides: Sequence[Checkout], runs: int) -> None:
    """Processor seconds of both, in turn."""
    case = next((case for case in CASES if case.name == sample and case.recorded is None), None)
    if case is None:
        raise SystemExit(f"--time: expected one of {', '.join(_samples())}, found {sample}")
    taken: list[list[float]] = [[] for _ in sides]
    with tempfile.TemporaryDirectory() as scratch:
        places = [Path(scratch) / str(k) for k in range(len(sides))]
        for side, place in zip(sides, places, strict=True):
            side.prepare(case, place)
        for turn in range(_TIMED + 1):
            for side, place, seconds in zip(sides, places, taken, strict=True):
                spent_s = _processor_s(side, _with_runs(_ONE_JOB, runs), place)
                seconds += [spent_s] if turn else []  # the first compiles
    for name, seconds in zip(("before", "after"), taken, strict=True):
        print(f"{name}: {median(seconds):.2f} s ({' '.join(f'{value:.2f}' for value in seconds)})")
    print(f"after : before {median(taken[1]) / median(taken[0]):.3f}  ({sample}, {runs} runs)")


def _samples() -> list[str]:
    return [case.name for case in CASES if case.name == case.source and case.recorded is None]


def _processor_s(side: Checkout, words: Sequence[str], here: Path) -> float:
    command, nothing = [sys.executable, "-c", side.code, *words, "--overwrite"], subprocess.DEVNULL
    process = subprocess.Popen(command, cwd=here, env=side.environment, stdout=nothing, stderr=nothing)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{side.folder}: `{' '.join(words)}` ended with {process.returncode}")
    return used.ru_utime + used.ru_stime


def chosen(patterns: Sequence[str] | None, *, slow: bool) -> list[Case]:
    """Those asked for may be slow."""
    if not patterns:
        return [case for case in CASES if slow or not case.slow]
    if unknown := [one for one in patterns if not any(fnmatch(case.name, one) for case in CASES)]:
        raise SystemExit(f"--cases: expected some of {', '.join(c.name for c in CASES)}; found {', '.join(unknown)}")
    return [case for case in CASES if any(fnmatch(case.name, one) for one in patterns)]


def main() -> int:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("before", type=Path)
    words.add_argument("after", type=Path)
    words.add_argument("--cases", nargs="+", metavar="NAME")
    words.add_argument("--all", action="store_true")
    words.add_argument("--runs", type=int, default=20)
    words.add_argument("--keep", type=Path, metavar="FOLDER")
    words.add_argument("--time", metavar="SAMPLE")
    given = words.parse_args()
    cases = chosen(given.cases, slow=given.all)
    sides = [Checkout(given.before), Checkout(given.after)]
    if given.time is not None:
        time_sample(given.time, sides, given.runs)
        return 0
    return compare_all(cases, sides, given.runs, given.keep and given.keep.resolve())


if __name__ == "__main__":
    sys.exit(main())
