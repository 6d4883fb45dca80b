"""A second process that fills the cache of compiled code while the first replay on a machine compiles.

Numba compiles under one lock, so a process compiles on one core. A replay begins with visible shares, which take about
as long to compile as accuracy, which it needs last. The second process replays a short recording in which nothing hides
anything: it begins with accuracy, and the first process finds that in the cache when it comes to it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from copem_replay.core.tracks import Float, Tracks
from copem_replay.perception.visibility import Observers, Statics, VisibilityModel

MODULE = "copem_replay.cli.compile_ahead"
"""This module by its name, also where it is the main one."""
FREE_BYTES = 2 << 30
"""Memory that has to be free: each of the two processes takes about 600 MB while it compiles."""


@contextmanager
def compile_ahead() -> Iterator[None]:
    """While the block lasts a second process compiles, where nothing is compiled yet and there is room for it."""
    process = None if _is_compiled() or not _is_room() else _start()
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


def _start() -> subprocess.Popen[bytes] | None:
    """The second process; None where none can be started."""
    command = [sys.executable or "", "-P", "-m", MODULE]  # -P: no module of the folder that the user works in
    nowhere = subprocess.DEVNULL
    try:
        return subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere)
    except OSError:  # no program of that name, no more processes: the command needs none
        return None


def _is_compiled() -> bool:
    """Whether the cache has what takes the second process longest, compiled for these arguments or for others."""
    from copem_replay.metrics.accuracy.kernel import add_up

    kernel: Any = add_up
    return any(Path(kernel.stats.cache_path).glob("*.add_up-*.nbi"))


def _is_room() -> bool:
    """Whether there are a core and memory for one more process."""
    from copem_replay.api.run import count_workers
    from copem_replay.pipeline.cost import free_bytes

    free = free_bytes()
    return count_workers(None) > 1 and (free is None or free > FREE_BYTES)


class NothingHidden(VisibilityModel):
    """Visible shares that take nothing to compile: all is seen from everywhere."""

    def shares(self, world: Tracks, static: Statics, observers: Observers) -> Float:
        """1 for every row from every unit: (U, P)."""
        return np.ones((len(observers.carrier_ix), len(world.frame_ix)))


def replay_in_advance() -> None:
    """Replay a short recording, with what most experiments use; first the truth, for which nothing is drawn."""
    from copem_replay.api.run import run

    error = {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}
    couple = {"detection": {"kind": "constant", "probability": 0.5}, "error": error}
    experiment = {
        "version": 1,
        "logs": [f"{Path(__file__).parent}/sample_logs/tc016d.mcap"],
        "runs": 2,
        "pems": {"any": [couple]},
        "units": {
            "ego": {"on": "ego", "pem": "any"},
            "mast": {"at": [7.5, 9.0], "yaw_deg": -130, "height_m": 5, "pem": "any"},
        },
        "visibility": {"kind": f"{MODULE}:NothingHidden"},
        "measure": {"onset": {"kind": "in_range", "range_m": 50}},
    }
    fused = {"ideal": {"units": "all"}, "gnn": {"units": "all", "fusion": {"kind": "gnn"}}}
    for configurations in ({"truth": {"units": "truth"}}, fused):
        run({**experiment, "configurations": configurations})


if __name__ == "__main__":
    replay_in_advance()
