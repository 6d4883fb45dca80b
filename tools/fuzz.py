"""Read hostile files: recordings, experiments and results folders that were hit in every way, and what becomes of them.

    python tools/fuzz.py --inputs 20000 --seed 1 --minutes 30
    python tools/fuzz.py results --inputs 20000

Targets are `mcap`, `trace` (OSI) and `folder` (rosbag2), with none of these given eight of ten inputs are MCAP; and
`experiment` (checked and run), `results` (compared, viewed, plotted, filmed, reported, run again over it with damaged
parts), `fit` and `convert`; and `map` (all formats). Every input is made from a seed. A
recording is surveyed and read, then its other lists are read and its messages copied; on the others commands are
called. That is done in a process whose memory is watched and that is ended when it takes more than 30 s of computing.
Good ends: it was read (and what was skipped is said), or it is refused in single lines. Printed are lines of JSON:
each defect with its seed and where the input is that shows it, at the end the counts, and how many inputs got past
the header: of a recording messages were found, a document is of its format.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fuzzing.commands import COMMANDS, make_originals, outcome_of, put_case
from fuzzing.containers import TARGETS, put
from fuzzing.maps import outcome_of_map, put_map
from fuzzing.mcap_model import Model, Piece
from fuzzing.samples import samples

LONGEST_S = 30.0
MOST_BYTES = 1_000_000_000
_ROOM_BYTES = 3 << 30  # of address space beside what is taken at the start
_MOST_CALLS = 600  # of commands in a process: writers of Rerun leave threads, whose stacks are address space
READ, REFUSED = "read", "refused"
MAP = "map"
_IN_MEMORY = Path("/dev/shm")  # nothing waits for a disk


def outcome(path: Path, looked: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """What becomes of a file: `read` or `refused`, or what is wrong with its end.

    It is surveyed and read; `looked` is called then, and its other lists are read and its messages copied.
    """
    from copem_replay.core.errors import InputError, RecordingError
    from copem_replay.experiment.draft.findings import survey_as_json
    from copem_replay.experiment.draft.survey import survey_recording
    from copem_replay.experiment.draft.template import describe_survey
    from copem_replay.io import recorded_lists as lists
    from copem_replay.io import recorded_lists as unit_lists
    from copem_replay.io.open import open_log
    from copem_replay.io.recording import read_log
    from copem_replay.io.schemas import osi_ground_truth as osi
    from copem_replay.io.write.source import open_source

    said: list[str] = []
    past = False  # the header: messages were found
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = survey_recording(path)
            json.dumps(survey_as_json(found), allow_nan=False)
            past = any(topic.messages for topic in found.topics)
            said += [*describe_survey(found), *([found.reason] if found.reason else [])]
            try:
                recording = read_log(path, name="log")
                said += recording.notes
                end = READ
            except InputError as error:
                said += error.problems
                end = REFUSED
                recording = None
            looked()
            if (end == READ) > found.readable:
                return {"outcome": "defect", "what": "read, but the survey says it cannot be"}
            if recording is not None:
                for topic in {c.topic: c.schema for c in open_log(path).channels if c.messages}.items():
                    try:
                        if topic[1] == osi.SENSOR_DATA:
                            lists.read_recorded(path, topic[0], recording.scene)
                        else:
                            unit_lists.read_described_lists(path, topic[0], recording.scene, recording.around)
                    except RecordingError as error:
                        said += error.problems
            try:
                original = open_source(path)
                for _message in original.messages({number: number for number in original.channels}):
                    pass
            except RecordingError as error:
                said += error.problems
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            frames = traceback.extract_tb(error.__traceback__)
            ours = [f for f in frames if "copem_replay" in f.filename]
            where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"
            return {"outcome": "defect", "what": f"{type(error).__name__} at {where}: {str(error)[:200]}"}
    for line in said:
        if len(line.splitlines()) > 1 or not all(c.isprintable() for c in line):
            return {"outcome": "defect", "what": f"not one printable line: {line[:150]!r}"}
    return {"outcome": end, "said": said, "past": past}


def _memory_bytes(what: str) -> int:
    """Resident memory of this process: `VmRSS` now, `VmHWM` its peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what):
            return int(line.split()[1]) * 1024
    return 0


Made = tuple[Path, str, Callable[[Any], dict[str, Any]]]
"""An input, what was done to it, and what says what becomes of it, with a pipe to tell that half of it is done."""


def _maker(folder: Path, most: int, own: bool, target: str | None) -> Callable[[str], Made]:
    """What makes the input of a seed."""
    if target in COMMANDS:
        originals = make_originals(folder / "originals", str(target))

        def command(seed: str) -> Made:
            case = put_case(originals, seed, folder, str(target))
            return case.folder, case.done, lambda pipe: outcome_of(case, originals.expected)

        return command
    if target == MAP:

        def site(seed: str) -> Made:
            path, done = put_map(seed, folder)
            return path, done, lambda pipe: outcome_of_map(path)

        return site
    all_samples = samples(most, own=own)
    warm = folder / "warm.mcap"
    for sample in all_samples:  # compiles
        warm.write_bytes(Model([Piece([*sample.schemas, *sample.channels, *sample.messages])]).written())
        outcome(warm)

    def recording(seed: str) -> Made:
        path, done = put(all_samples, seed, folder, target)
        return path, done, lambda pipe: outcome(path, lambda: pipe.send(None))

    return recording


def _serve(pipe: Any, folder: str, most: int, own: bool, target: str | None) -> None:
    """Make and read the inputs that are asked for, until there are no more."""
    make = _maker(Path(folder), most, own, target)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    room, anything = pages * resource.getpagesize() + _ROOM_BYTES, resource.getrlimit(resource.RLIMIT_AS)
    at_start = _memory_bytes("VmRSS")
    pipe.send("ready")
    while (seed := pipe.recv()) is not None:
        path, done, read = make(seed)
        pipe.send({"seed": seed, "done": done, "file": str(path)})
        resource.setrlimit(resource.RLIMIT_AS, (room, anything[1]))
        Path("/proc/self/clear_refs").write_text("5")
        begin, kept = time.process_time(), _memory_bytes("VmRSS") - at_start  # of inputs before, in this long process
        found = read(pipe)
        found |= {"seconds": time.process_time() - begin, "bytes": _memory_bytes("VmHWM") - max(kept, 0)}
        resource.setrlimit(resource.RLIMIT_AS, anything)
        pipe.send(found)


class _Worker:
    """A process that reads; started again when it had to be ended."""

    def __init__(self, folder: Path, most: int, own: bool, target: str | None) -> None:
        self._arguments = (str(folder), most, own, target)
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, *self._arguments), daemon=True)
        self._process.start()
        theirs.close()
        self._pipe.recv()

    def end(self) -> None:
        self._process.kill()
        self._process.join()

    def start_again(self) -> None:
        self.end()
        self._start()

    def _answers(self) -> bool:
        """Wait for an answer: as long as it may compute, or do nothing; waiting for a processor takes no time."""
        begin, wall = self._computed_s(), time.monotonic() - self._queued_s()
        while not self._pipe.poll(0.2):
            if self._computed_s() - begin > LONGEST_S or time.monotonic() - self._queued_s() - wall > 2 * LONGEST_S:
                return False
        return True

    def _queued_s(self) -> float:
        return int(Path(f"/proc/{self._process.pid}/schedstat").read_text().split()[1]) / 1e9

    def _computed_s(self) -> float:
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def read(self, seed: str) -> dict[str, Any]:
        """What becomes of the input of a seed."""
        about: dict[str, Any] = {"seed": seed, "done": "?"}
        try:
            self._pipe.send(seed)
            about = self._pipe.recv()
            for _ in range(2):
                if not self._answers():
                    break
                if (end := self._pipe.recv()) is not None:
                    return about | end
            found = {"outcome": "defect", "what": f"takes more than {LONGEST_S:g} s", "seconds": LONGEST_S}
        except EOFError:
            found = {"outcome": "defect", "what": "the process died", "seconds": 0.0}
        self.start_again()
        return about | {"bytes": 0} | found


def seeds(first: int, number: int) -> Iterator[str]:
    return (f"{first}:{k}" for k in range(number))


def fuzz(
    inputs: int,
    seed: int,
    *,
    minutes: float = 1e9,
    most: int = 60,
    own: bool = False,
    keep: Path | None = None,
    target: str | None = None,
) -> dict[str, Any]:
    """Read `inputs` files. The counts, the worst, and the defects; `keep`: where files that show one are put."""
    counts, past, worst_s, worst_bytes = Counter[str](), 0, (0.0, ""), (0, "")
    defects: list[dict[str, Any]] = []
    until = time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory(dir=_IN_MEMORY if _IN_MEMORY.is_dir() else None) as folder:
        worker = _Worker(Path(folder), most, own, target)
        for k, name in enumerate(seeds(seed, inputs), 1):
            if time.monotonic() > until:
                break
            if target in COMMANDS and k % _MOST_CALLS == 0:
                worker.start_again()
            found = worker.read(name)
            if found["outcome"] != "defect" and found["bytes"] > MOST_BYTES:
                found |= {"outcome": "defect", "what": f"takes {found['bytes'] / 1e6:.0f} MB"}
            counts[found["outcome"]] += 1
            past += found.get("past", False)
            worst_s = max(worst_s, (found["seconds"], name))
            worst_bytes = max(worst_bytes, (found["bytes"], name))
            if found["outcome"] == "defect":
                if keep is not None and "file" in found:
                    found["file"] = str(_kept(Path(found["file"]), keep / name.replace(":", "_")))
                found.pop("said", None)
                defects.append(found)
                print(json.dumps(found), flush=True)
        worker.end()
    return {
        "inputs": sum(counts.values()),
        "outcomes": dict(counts),
        "past_header": past,
        "worst_s": round(worst_s[0], 3),
        "worst_s_seed": worst_s[1],
        "worst_mb": round(worst_bytes[0] / 1e6),
        "worst_mb_seed": worst_bytes[1],
        "defects": defects,
    }


def _kept(made: Path, place: Path) -> Path:
    """The input put where it stays."""
    place = place / made.name
    place.parent.mkdir(parents=True, exist_ok=True)
    if made.is_dir():
        shutil.copytree(made, place, dirs_exist_ok=True, symlinks=True)
    else:
        shutil.copyfile(made, place)
    return place


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", nargs="?", choices=(*TARGETS, *COMMANDS, MAP))
    parser.add_argument("--inputs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--keep", type=Path, default=Path("out/fuzz"), help="where files that show a defect are put")
    asked = parser.parse_args()
    found = fuzz(asked.inputs, asked.seed, minutes=asked.minutes, keep=asked.keep, target=asked.target)
    kinds = Counter(d["what"].split(": ")[0] for d in found["defects"])
    print(json.dumps({**found, "defects": dict(kinds.most_common())}))
    print(f"got past the header: {found['past_header']} of {found['inputs']}")
    return 1 if kinds else 0


if __name__ == "__main__":
    sys.exit(main())
