"""The log again: figures of single runs need the world itself, which a results folder names but does not hold."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from copem_replay.core.errors import InputError, RecordingError
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.io.checksum import sha256_of, stamps_of
from copem_replay.io.recording import Recording
from copem_replay.io.together import at_hand
from copem_replay.metrics.config import Objects
from copem_replay.pipeline.prepare import Replay, prepare
from copem_replay.pipeline.study_log import content_of

if TYPE_CHECKING:
    from copem_replay.io.together import File
    from copem_replay.results.provenance import LogFile
    from copem_replay.results.read import Results


def reread(results: Results, log: str, object_id: str) -> Replay:
    """One log made ready once more, looked at for one object only.

    Raises RecordingError, one line, where the recording is missing or not the one that was replayed, or has no ego.
    """
    alone = of_log(results.experiment, log)
    measure = alone.measure.model_copy(update={"objects": Objects(ids=(object_id,))})
    experiment = alone.model_copy(update={"measure": measure})
    recording = read_again(results, log, experiment)
    if recording.scene.ego_ix < 0:
        raise RecordingError("no ego in this study, whose runs could be drawn", path=recording.path)
    return prepare(recording, experiment)


def read_again(results: Results, log: str, experiment: Experiment) -> Recording:
    """A log of the results as an experiment, theirs or one made of it, reads it.

    Raises RecordingError, one line, where the recording is missing or not the one that was replayed.
    """
    file = next(file for file in results.provenance.logs if file.name == log)
    path, place = results.log_path(log), results.log_place(log)
    try:
        with at_hand(place) as here:
            stamps, found = stamps_of(here), sha256_of(here)
    except InputError as error:
        raise RecordingError(f"{error}; put the log back to draw its runs") from None
    _check(found, file, path)
    recordings, refused = read_logs(of_log(experiment, log), [place], None)
    if refused:
        raise RecordingError([f"{refusal.path}: {refusal.reason}" for refusal in refused])
    if recordings[0].stamps != stamps:  # a copy of its own, or it has changed since
        _check(content_of(recordings[0]), file, path)
    # Draws are addressed by the log's name, which depends on what else was replayed.
    return replace(recordings[0], scene=replace(recordings[0].scene, log=log))


def _check(found: str, file: LogFile, path: File) -> None:
    """Raise RecordingError where a recording is another than the one that was replayed."""
    if found != file.sha256:
        raise RecordingError(
            f"expected the log that was replayed, SHA-256 {file.sha256[:12]}…, found {found[:12]}…; "
            "put that log back, or run the experiment again",
            path=path,
        )
