"""Which container a recording comes in: one table, by the path and the first bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from copem_replay.io.containers.osi_trace import is_trace, open_trace
from copem_replay.io.containers.rosbag2 import open_bag
from copem_replay.io.log import Log, open_mcap


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


def open_log(path: Path) -> Log:
    """Look at a recording. Raises RecordingError where it is none, or nothing in it can be read."""
    return next(container for container in CONTAINERS if container.takes(path)).open(path)


def name_of(path: Path) -> str:
    """What a log is called: a file without its suffix, a folder as it is."""
    return path.name if path.is_dir() else path.stem
