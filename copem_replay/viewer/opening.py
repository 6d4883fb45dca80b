"""The recordings of a results folder, and the instant at which each of them opens: just before the first onset.

A layout in a recording cannot hold an instant (Rerun 0.41), and addresses with one (`#when=`) lead to servers only. So
the opening program sets it: for the viewer on this machine `seek`, for a browser the page of `viewer/web.py`.
"""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from copem_replay.core.errors import CopemError
from copem_replay.results.read import Results, open_results
from copem_replay.viewer.selection import SHOWN_OBJECTS, telling
from copem_replay.viewer.sink import ELAPSED

BEFORE_ONSET_S = 0.5
"""A recording opens this long before the first onset (chosen: what changes is about to)."""
HOST = "127.0.0.1"
READY_S, AGAIN_S = 60.0, 0.2
"""How long a viewer may take to load a recording, and how often it is asked whether it has (chosen)."""
_PATTERNS = ("replay.rrd", "replay.*.rrd", "replay/**/*.rrd", "replay_*.rrd", "replay_*/**/*.rrd")
_PART = re.compile(r"\.configurations_\d+(-\d+)?$")


def recordings_of(folder: Path) -> list[Path]:
    """The recordings in a results folder: absolute paths, each once, the first shown run first."""
    place = folder.absolute()  # no name that looks like an option
    found = [path for pattern in _PATTERNS for path in sorted(place.glob(pattern), key=_order) if path.is_file()]
    return list(dict.fromkeys(found))


def _order(path: Path) -> Path:
    """A recording before its further configurations: `replay.rrd`, then `replay.configurations_7-12.rrd`."""
    return path.with_suffix("")


def opening_s(folder: Path, files: Sequence[Path]) -> dict[Path, float]:
    """The instant at which each recording opens, in seconds since its log starts.

    Half a second before the earliest onset among the objects of interest. A recording of no known run, or without an
    onset, is left out: it opens at its beginning.
    """
    found = {}
    try:
        results = open_results(folder)
        runs = _runs_of(results)
        truths = [name for name in results.truth if name in results.rows.configurations]
        for path in files:
            stem = _PART.sub("", path.relative_to(folder.absolute()).with_suffix("").as_posix())
            if stem in runs:
                log, run = runs[stem]
                (rows,) = results.each(log=log)
                onset_s = _first_onset_s(rows[rows["run"] == run], truths)
                if onset_s is not None:
                    found[path] = max(0.0, onset_s - BEFORE_ONSET_S)
    except (CopemError, KeyError, TypeError):
        return {}  # a recording can be seen without tables beside it
    return found


def _runs_of(results: Results) -> dict[str, tuple[str, int]]:
    """The log and run that each recording shows, by its path in the folder without its suffix."""
    shown = results.provenance.data["runs_shown"]
    several = len(shown) > 1
    return {
        (f"{one['file']}/{log}" if several else one["file"]): (log, int(one["run"]))
        for log, runs in shown.items()
        for one in runs
    }


def _first_onset_s(table: pd.DataFrame, truths: Sequence[str]) -> float | None:
    """The earliest onset of the objects that words and lanes tell of; None: there is none."""
    if not len(table):
        return None
    of_interest = telling(table, truths, SHOWN_OBJECTS)
    return float(table.loc[table["object_id"].isin(of_interest), "onset_s"].min())


@dataclass(frozen=True)
class Identity:
    """What a viewer tells recordings apart by."""

    application: str
    recording: str


def identities(files: Sequence[Path]) -> dict[Path, Identity]:
    """The identity of each recording; files that are no recordings are left out."""
    from rerun.chunk import RrdReader

    found = {}
    for path in files:
        try:
            (entry,) = RrdReader(str(path)).recordings()
        except (OSError, RuntimeError, ValueError):
            continue
        found[path] = Identity(entry.application_id, entry.recording_id)
    return found


def open_viewer(folder: Path, files: Sequence[Path]) -> int:
    """Open recordings in the viewer on this machine, and wait until it ends. Returns its exit code."""
    instants = opening_s(folder, files)
    known = identities(list(instants))
    port = free_port()
    # The module, not the script: it is there in every environment that has rerun-sdk, whatever the PATH.
    # The viewer shows what it opened last.
    words = [sys.executable, "-m", "rerun", "--bind", HOST, "--port", str(port), *map(str, reversed(files))]
    with subprocess.Popen(words) as process:
        try:
            at = {identity.recording: instants[path] for path, identity in known.items()}
            seek(f"rerun+http://{HOST}:{port}/proxy", at, lambda: process.poll() is None)
            return process.wait()
        except BaseException:  # an interrupt: the terminal told the viewer, too
            process.terminate()
            raise


def seek(url: str, instants_s: Mapping[str, float], alive: Callable[[], bool]) -> None:
    """Set the instant of each recording, by its id, once the viewer at `url` has loaded it.

    Gives up when the viewer has ended, or has not loaded it in time: the recording then opens at its beginning.
    """
    waiting, until = dict(instants_s), time.monotonic() + READY_S
    while waiting and alive() and time.monotonic() < until:
        for name in _set(url, waiting):
            del waiting[name]
        if waiting:
            time.sleep(AGAIN_S)


def _set(url: str, instants_s: Mapping[str, float]) -> set[str]:
    """Set the instants of the recordings that the viewer has, and name those."""
    from rerun.experimental import ViewerClient

    done: set[str] = set()
    try:
        client = ViewerClient.connect(url)
        state = client.get_state()
        for recording in [] if state.loading else state.recordings:
            name = recording.store_id.rpartition(":")[2]  # what is before it differs from viewer to viewer
            if name in instants_s and recording.timelines:
                client.set_time(ELAPSED, duration=instants_s[name], play_state="paused", recording=recording.store_id)
                done.add(name)
    except (OSError, RuntimeError, ValueError):  # it does not answer yet, or has no such recording yet
        pass
    return done


def free_port() -> int:
    """A port of this machine on which nothing listens."""
    with socket.socket() as any_port:
        any_port.bind((HOST, 0))
        return int(any_port.getsockname()[1])
