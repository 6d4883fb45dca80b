"""The log again: figures of single runs need the world itself, which a results folder names but does not hold."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from copem_replay.check import read_logs
from copem_replay.errors import RecordingError
from copem_replay.measure_keys import Objects
from copem_replay.plot.folder import Results
from copem_replay.replay import Replay, prepare


def reread(results: Results, log: str, object_id: str) -> Replay:
    """One log made ready once more, looked at for one object only.

    Raises RecordingError, one line, where the recording is missing or not the one that was replayed, or has no ego.
    """
    file = next(file for file in results.logs if file.name == log)
    try:
        with file.path.open("rb") as content:
            found = hashlib.file_digest(content, "sha256").hexdigest()
    except OSError as error:
        raise RecordingError(
            f"{file.path}: cannot be read: {error.strerror}; put the log back to draw its runs"
        ) from None
    if found != file.sha256:
        raise RecordingError(
            f"{file.path}: expected the log that was replayed, SHA-256 {file.sha256[:12]}…, found {found[:12]}…; "
            "put that log back, or run the experiment again"
        )
    measure = results.experiment.measure.model_copy(update={"objects": Objects(ids=(object_id,))})
    experiment = results.experiment.model_copy(update={"measure": measure})
    recordings, refused = read_logs(experiment, [file.path], results.source)
    if refused:
        raise RecordingError([f"{refusal.path}: {refusal.reason}" for refusal in refused])
    recording = recordings[0]
    if recording.scene.ego_ix < 0:
        raise RecordingError(f"{file.path}: no ego in this study, whose runs could be drawn")
    # Draws are addressed by the log's name, which depends on what else was replayed.
    return prepare(replace(recording, scene=replace(recording.scene, log=log)), experiment)
