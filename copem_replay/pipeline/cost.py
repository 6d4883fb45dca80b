"""The cost of a run: its time, printed on the terminal alone as results are the same on any machine, and its memory.

Whether the rows of a replay fit in free memory is checked before the first run.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import psutil

from copem_replay.core.compiled import compiling
from copem_replay.core.errors import ExperimentError
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.replay import BlockOutcome

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]

# Time.

MOSTLY = 0.5
LONG_S = 10.0
"""A run that takes longer than this gets a note on what takes more than that share of it; shorter ones need none."""


@dataclass
class RunCost:
    """Seconds of a run: of all of it, of its workers, and of these what measured accuracy.

    `compiled`: kernels had to be compiled, so the next run takes less.
    """

    total_s: float = 0.0
    in_blocks_s: float = 0.0  # wall-clock time in which blocks were computed
    worked_s: float = 0.0  # summed over workers
    accuracy_s: float = 0.0
    compiled: bool = False

    def notes(self) -> tuple[str, ...]:
        """A note on accuracy where it is most of a long run, and how to leave it out."""
        if self.compiled or self.total_s <= LONG_S or self.worked_s <= 0:
            return ()
        share = self.accuracy_s / self.worked_s * self.in_blocks_s / self.total_s
        if share <= MOSTLY:
            return ()
        return (
            f"accuracy took {100 * share:.0f} % of the {self.total_s:.0f} s of this replay; "
            "`measure: {accuracy: false}` leaves it out",
        )

    def add(self, in_blocks_s: float, outcomes: Sequence[BlockOutcome]) -> None:
        """Add the seconds of blocks that were computed within `in_blocks_s`."""
        self.in_blocks_s += in_blocks_s
        self.worked_s += sum(outcome.worked_s for outcome in outcomes)
        self.accuracy_s += sum(outcome.accuracy_s for outcome in outcomes)


@contextmanager
def watch_cost() -> Iterator[RunCost]:
    """The cost of the `with` block; `total_s` and `compiled` are set at its end."""
    cost, began, begun = RunCost(), time.perf_counter(), compiling.begun
    yield cost
    cost.total_s, cost.compiled = time.perf_counter() - began, compiling.begun > begun


# Memory.

AT_LEAST_BYTES = {False: 250, True: 400}
"""Bytes of a row of `detections.parquet`, without accuracy and with it, while the rows of a log are counted (measured:
a row has 146 and 234, held twice). What accuracy has list by list waits in a file."""
ABOUT_BYTES = 1000
"""Bytes of a row with all intermediate results and statistics (measured: tc016d.yaml with accuracy grows by 600 a row
from 500 runs to 10,000)."""
OBSERVED_BYTES = 400
"""Bytes of a unit's view of a measured object at a frame, whatever the number of runs: about fifty numbers."""


Size: TypeAlias = tuple[int, int]
"""Of a log: rows of one run, and views of measured objects by all units."""


def estimate_size(replay: Replay) -> Size:
    """Estimated rows of one run of a log, and how often units look at measured objects."""
    experiment, measured = replay.expanded, replay.episodes.object_ix
    states = int(np.diff(replay.truth.start)[np.isin(replay.truth.object_ix, measured)].sum())
    return len(measured) * len(experiment.configurations), states * len(experiment.modelled)


def memory_notes(ready: Sequence[Replay], experiment: Experiment, other_sizes: Sequence[Size] = ()) -> list[str]:
    """A note where the runs may take more memory than is free. Raises ExperimentError where they certainly do.

    `other_sizes`: sizes of further logs.
    """
    sizes, free, runs = [*map(estimate_size, ready), *other_sizes], free_bytes(), experiment.runs
    rows_a_run = sum(rows for rows, _ in sizes)
    expected_bytes = rows_a_run * ABOUT_BYTES * runs + max((views for _, views in sizes), default=0) * OBSERVED_BYTES
    if free is None or expected_bytes <= free:
        return []
    rows = f"{runs} runs of {rows_a_run} {'row' if rows_a_run == 1 else 'rows'} each"
    least = rows_a_run * AT_LEAST_BYTES[experiment.measure.accuracy] * runs
    if least > free and runs > 1:
        few = max(free // (rows_a_run * ABOUT_BYTES), 1)
        raise ExperimentError(
            f"{rows} take at least {_format_gb(least)}, and {_format_gb(free)} are free; take {few} or fewer"
        )
    return [f"{rows} may take {_format_gb(expected_bytes)}, and {_format_gb(free)} are free"]


def free_bytes() -> int | None:
    """Memory that this process can still get: the least of machine, control group and own limit; None: unknown."""
    limits = [_free_machine_bytes(), _free_group_bytes(), _free_process_bytes()]
    return min((free for free in limits if free is not None), default=None)


def _free_machine_bytes() -> int | None:
    try:
        return int(psutil.virtual_memory().available + psutil.swap_memory().free)
    except OSError:  # nothing says so: a container without /proc
        return None


def _free_group_bytes() -> int | None:
    most, used = (_read_text(f"/sys/fs/cgroup/memory.{name}").strip() for name in ("max", "current"))
    cached = re.search(r"^file (\d+)$", _read_text("/sys/fs/cgroup/memory.stat"), re.MULTILINE)
    if not (most.isdecimal() and used.isdecimal()):  # no limit ("max"), or no control groups of version 2
        return None
    return max(int(most) - int(used) + (int(cached[1]) if cached else 0), 0)


def _free_process_bytes() -> int | None:
    if resource is None:
        return None
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if most == resource.RLIM_INFINITY else max(most - int(psutil.Process().memory_info().vms), 0)


def peak_bytes() -> int | None:
    """The peak memory of this process; None: the system does not say."""
    if resource is None:
        peak_wset: int | None = getattr(psutil.Process().memory_info(), "peak_wset", None)  # Windows
        return peak_wset
    peak: int = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # KiB but on macOS


def return_memory() -> None:
    """Give freed memory back to the system: Arrow's pool keeps some, and glibc what threads have freed.

    Measured: 160 of 600 MB after 20 runs of a drive of 5 minutes with 100 objects.
    """
    if (arrow := sys.modules.get("pyarrow")) is not None:
        arrow.default_memory_pool().release_unused()
    if sys.platform.startswith("linux"):
        import ctypes

        with suppress(AttributeError):  # another C library than glibc
            ctypes.CDLL(None).malloc_trim(0)


def _read_text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError:
        return ""


def _format_gb(size: int) -> str:
    return f"{size / 1e9:.3g} GB"
