"""How much memory the rows of a replay take, against what is free: said before, not found out hours later."""

from __future__ import annotations

import re
import resource
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from copem_replay.core.errors import ExperimentError
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.list_rates import list_times
from copem_replay.pipeline.prepare import Replay

AT_LEAST_BYTES = {False: (250, 0), True: (400, 16)}
"""Of a row of `detections.parquet`, and of each list of its object's stay, without accuracy and with it, while all are
put together (measured: 146 and 234 of the row itself, held twice; of a list two numbers of four bytes, held twice)."""
ABOUT_BYTES = {False: (1000, 0), True: (3000, 45)}
"""The same with all that is made on the way, statistics too. Measured, by how much the peak of `run` without `show` and
`sweep` grows from one number of runs to the other, in bytes a row:

| | runs | lists a row | grows by |
|---|---|---|---|
| crossing_share.yaml without accuracy | 120, 480 | 0 | 650 |
| tc016d.yaml | 2000, 10 000 | 76 | 6000 |
| crossing_share.yaml | 120, 480 | 431 | 23 500 |
| crossing.yaml | 10, 80 | 979 | 41 200 |
"""


Size: TypeAlias = tuple[int, float]
"""Of a log: rows of a run, and, with accuracy, about how many lists the stays of these rows have."""


def size_of(replay: Replay) -> Size:
    """How much a log gives."""
    written = replay.expanded.written
    lists = _lists_a_run(replay) if written.measure.accuracy else 0.0
    return len(replay.episodes.object_ix) * len(written.configurations), lists


def memory_notes(ready: Sequence[Replay], experiment: Experiment, others: Sequence[Size] = ()) -> list[str]:
    """A note where the runs may take more memory than is free. Raises ExperimentError where they certainly do.

    `others`: sizes of further logs.
    """
    accuracy, free = experiment.measure.accuracy, free_bytes()
    sizes = [*map(size_of, ready), *others]
    rows_a_run, lists_a_run = sum(rows for rows, _ in sizes), sum(lists for _, lists in sizes)
    about, least = (
        round(rows_a_run * row[accuracy][0] + lists_a_run * row[accuracy][1]) for row in (ABOUT_BYTES, AT_LEAST_BYTES)
    )
    if free is None or about * experiment.runs <= free:
        return []
    few = max(free // about, 1)
    rows = f"{experiment.runs} runs of {rows_a_run} {'row' if rows_a_run == 1 else 'rows'} each"
    if least * experiment.runs > free and experiment.runs > 1:
        raise ExperimentError(
            f"{rows} take at least {_gb(least * experiment.runs)}, and {_gb(free)} are free; take {few} or fewer"
        )
    return [f"{rows} may take {_gb(about * experiment.runs)}, and {_gb(free)} are free"]


def _lists_a_run(replay: Replay) -> float:
    """About how many lists the stays of a run's rows have: by the seconds from first frame to the episode's end."""
    truth, episodes = replay.truth, replay.episodes
    first_s = np.full(len(replay.scene.object_ids), np.inf)
    np.minimum.at(first_s, truth.row_object_ix, truth.captured_s[truth.frame_ix])
    stays_s = float((episodes.ended_s - first_s[episodes.object_ix]).sum())
    once = replay.expanded.written.model_copy(update={"runs": 1})
    rates = (times.rate_hz or 0.0 for times in list_times(replay, once).values())
    return stays_s * sum(rates)


def free_bytes() -> int | None:
    """Memory that this process can still get: of the machine, of its control group, of its own limit; None: unknown."""
    known = [_of_machine(), _of_group(), _of_process()]
    return min((free for free in known if free is not None), default=None)


def _of_machine() -> int | None:
    found = re.findall(r"^(?:MemAvailable|SwapFree):\s+(\d+) kB$", _text("/proc/meminfo"), re.MULTILINE)
    return sum(map(int, found)) * 1024 if found else None


def _of_group() -> int | None:
    most, used = (_text(f"/sys/fs/cgroup/memory.{name}").strip() for name in ("max", "current"))
    cached = re.search(r"^file (\d+)$", _text("/sys/fs/cgroup/memory.stat"), re.MULTILINE)
    if not (most.isdecimal() and used.isdecimal()):  # no limit, or none that is known here
        return None
    return max(int(most) - int(used) + (int(cached[1]) if cached else 0), 0)


def _of_process() -> int | None:
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = re.search(r"^VmSize:\s+(\d+) kB$", _text("/proc/self/status"), re.MULTILINE)
    return None if most == resource.RLIM_INFINITY or used is None else max(most - int(used[1]) * 1024, 0)


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError:
        return ""


def _gb(size: int) -> str:
    return f"{size / 1e9:.3g} GB"
