"""Which container a recording comes in: one table, by the path and the first bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from copem_replay.io.containers.joined import Joined, open_joined
from copem_replay.io.containers.osi_trace import is_trace, open_trace
from copem_replay.io.containers.rosbag2 import open_bag
from copem_replay.io.log import Log, open_mcap
from copem_replay.io.together import Local, Together


@dataclass(frozen=True)
class Container:
    """A container: which paths it takes, and how one of them is opened. `open` raises RecordingError."""

    name: str
    takes: Callable[[Path], bool]
    open: Callable[[Path], Log]


CONTAINERS: Final = (
    Container("rosbag2 folder", Path.is_dir, open_bag),
    Container("OSI single-channel trace", is_trace, open_trace),
    Container("MCAP file", lambda _path: True, open_mcap),  # all else: its errors say what a file is instead
)
"""The first that takes a path opens it."""


def open_log(place: Local) -> Log:
    """Look at a recording, or at several as one. Raises RecordingError where nothing in one of them can be read."""
    return open_joined(place, _open_one) if isinstance(place, Together) else _open_one(place)


def together_of(log: Log) -> Together | None:
    """The recordings that a log is made of; None: it is one."""
    return log.place if isinstance(log, Joined) else None


def _open_one(path: Path) -> Log:
    return next(container for container in CONTAINERS if container.takes(path)).open(path)


def name_of(path: Path) -> str:
    """What a log is called: a file without its suffix, a folder as it is."""
    return path.name if path.is_dir() else path.stem
