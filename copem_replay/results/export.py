"""Exporters: each writes one shown run of one log as a file of its own kind. They are handed to `write_results`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import RecordingError
from copem_replay.io.checksum import check_unchanged, sha256_of, stamps_of
from copem_replay.io.recording import Recording
from copem_replay.io.together import at_hand, first_of

if TYPE_CHECKING:
    import pandas as pd

    from copem_replay.experiment.schema import Configuration
    from copem_replay.pipeline.selected_runs import OneRun, ShownRun


@dataclass(frozen=True)
class RunToExport:
    """One run of one log, in the configurations that are shown.

    `one`: in the configurations that are shown. `every`: all of the experiment's, in its order: colours go by it.
    `table`: the rows of `detections.parquet` of this log and run. `summary`: of all logs and runs. `manifest`: what
    made the file.
    """

    recording: Recording
    shown: ShownRun
    one: OneRun
    every: Mapping[str, Configuration]
    table: pd.DataFrame
    summary: pd.DataFrame
    manifest: dict[str, str]


@dataclass(frozen=True)
class Exporter:
    """A kind of file. `suffix`: with the dot. `write`: writes the file and returns notes for the user.

    `names`: of the files that come of a stem and so many configurations, where they may be several.

    `write` raises OutputError where the file cannot be written, and RecordingError where the recording cannot be read:
    the results are then without it, and say so.
    """

    suffix: str
    write: Callable[[Path, RunToExport], list[str]]
    names: Callable[[str, int], list[str]] | None = None

    def files(self, stem: str, configurations: int) -> list[str]:
        """What the files are called, relative to what the stem is relative to."""
        return [stem + self.suffix] if self.names is None else self.names(stem, configurations)


def _write_mcap(path: Path, run: RunToExport) -> list[str]:
    from copem_replay.io.write.mcap import write_mcap
    from copem_replay.io.write.message_family import family_of
    from copem_replay.results.truth_scene import truth_scene

    recording = run.recording
    with at_hand(recording.place) as here:
        stamps = stamps_of(here)
        known = recording.sha256 is not None or recording.stamps is not None
        if known and stamps != recording.stamps and sha256_of(here) != recording.sha256:
            raise RecordingError("it is no longer what was replayed", path=first_of(recording.place))
        notes = write_mcap(
            path,
            here,
            run.one.replay.scene,
            run.one.run_tracks,
            run.table,
            run.manifest,
            family_of(recording),
            recording.window,
            truth_scene(run.one, run.table),
            configuration_colours(run.every),
        )
        check_unchanged(stamps)
    return notes


MCAP = Exporter(".mcap", _write_mcap)
"""The recording with the fused lists added, as MCAP."""
