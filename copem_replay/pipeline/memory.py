"""How much memory the rows of a replay take, against what is free: said before, not found out hours later."""

from __future__ import annotations

import re
import resource
from collections.abc import Sequence
from pathlib import Path

from copem_replay.core.errors import ExperimentError
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay

AT_LEAST_BYTES = {False: 250, True: 400}
"""Of a row of `detections.parquet`, without accuracy and with it, while all are put together (measured: 146 and 234 of
the row itself, held twice)."""
ABOUT_BYTES = {False: 1000, True: 5000}
"""The same with all that is made on the way, statistics too (measured: 500 and 4000)."""


def memory_notes(ready: Sequence[Replay], experiment: Experiment) -> list[str]:
    """A note where the runs may take more memory than is free. Raises ExperimentError where they certainly do."""
    rows_a_run = sum(len(r.episodes.object_ix) * len(r.expanded.written.configurations) for r in ready)
    about, free = rows_a_run * ABOUT_BYTES[experiment.measure.accuracy], free_bytes()
    if free is None or about * experiment.runs <= free:
        return []
    few = max(free // about, 1)
    rows = f"{experiment.runs} runs of {rows_a_run} {'row' if rows_a_run == 1 else 'rows'} each"
    least = rows_a_run * experiment.runs * AT_LEAST_BYTES[experiment.measure.accuracy]
    if least > free and experiment.runs > 1:
        raise ExperimentError(f"{rows} take at least {_gb(least)}, and {_gb(free)} are free; take {few} or fewer")
    return [f"{rows} may take {_gb(about * experiment.runs)}, and {_gb(free)} are free"]


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
