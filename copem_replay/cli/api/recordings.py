"""Recordings: what is in one, what it says, and the experiment to begin with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import Scene, Tracks
from copem_replay.io.recording import Recording
from copem_replay.io.window import WindowSeconds

if TYPE_CHECKING:  # of types alone
    from collections.abc import Sequence

    from copem_replay.cli.api.study import AnyExperiment, AnyPath
    from copem_replay.experiment.draft.findings import Survey
    from copem_replay.io.config import EgoTopic


def read_recordings(experiment: AnyExperiment) -> list[Recording]:
    """Read the recordings an experiment names, with its ego, topic, window and recorded units.

    Every recording gets a name of its own, `scene.log`: that of its file, with its folder where two are alike.

    Raises InputError with all problems at once: of the experiment, of each recording, and of both together.

    >>> [recording.scene.log for recording in cr.read_recordings("logs/tc016d.yaml")]
    ['tc016d']
    """
    from copem_replay.cli.api.study import study_of

    return list(study_of(experiment).recordings)


def read_recording(
    path: AnyPath,
    ego: str | EgoTopic | None = None,
    topic: str | None = None,
    window_s: WindowSeconds = None,
) -> Recording:
    """Read one recording: an MCAP file, a rosbag2 folder or an OSI trace.

    `ego`: id of the ego vehicle; None: the one the recording names. `topic`: where the true objects are; None: the only
    such topic. `window_s`: what is read, [from, to] in seconds since the first message of the truth; None: all.
    The result holds `scene` and `truth`, whose arrays are (1, P): one run, P rows, metres and radians, east and north.

    Raises RecordingError: no such file, an unknown format, no true objects, no such ego, several topics to choose from.

    >>> recording = cr.read_recording("logs/tc016d.mcap", window_s=(0, 2))
    >>> len(recording.scene.object_ids), recording.truth.x_m.shape
    (9, (1, 189))
    """
    from copem_replay.io.open import name_of
    from copem_replay.io.recording import read

    return read(Path(path), name=name_of(Path(path)), ego=ego, topic=topic, window_s=window_s)


def read_lists(path: AnyPath, topic: str, scene: Scene) -> Tracks:
    """Read lists of objects back that a replay has written as `osi3.SensorData`, or that a unit has recorded.

    `scene`: of the recording that was replayed; its ids tell which objects they are. The result has one run: values
    (1, P) in metres, radians and m/s, lists (F,) with `captured_s`, and `arrives_s` (1, F) in seconds since the start.

    Raises RecordingError: no such topic of osi3.SensorData, a message that cannot be decoded.

    >>> scene = cr.read_recording("logs/tc016d.mcap").scene
    >>> lists = cr.read_lists("out/tc016d/replay.mcap", "copem/PEM/objects", scene)
    >>> len(lists.stamp_ns), lists.x_m.shape[0]
    (81, 1)
    """
    from copem_replay.io.recorded_osi import read_lists as read

    return read(Path(path), topic, scene)


def inspect_recording(path: AnyPath) -> dict[str, Any]:
    """Survey a recording: topics, true objects, lists of units, span in seconds, rates in Hz, ego, what is missing.

    The result is plain data, as of `copem-replay info --json`. A recording that cannot be read raises nothing:
    `readable` is then False, and `reason` says why.

    >>> found = cr.inspect_recording("logs/tc016d.mcap")
    >>> found["readable"], [topic["role"] for topic in found["topics"]]
    (True, ['truth'])
    """
    from copem_replay.experiment.draft.findings import as_json
    from copem_replay.experiment.draft.survey import survey

    return as_json(survey(Path(path)))


def draft_experiment(path: AnyPath) -> str:
    """Draft an experiment that replays a recording: YAML with comments, its paths relative to the working folder.

    The text is what `copem-replay init` prints. Ego, a mast and recorded units are guesses, each with a comment.

    Raises RecordingError where no list of true objects is readable, or the path of the recording is not UTF-8.

    >>> print(cr.draft_experiment("logs/tc016d.mcap").splitlines()[0])
    # Replays tc016d.mcap, 8.0 s: 2 pedestrian, 1 bicycle, 4 car, 1 truck.
    """
    text, found = draft_of(Path(path))
    if text is None:
        raise RecordingError(found.reason or f"{path}: no list of true objects")
    encodable(path)
    return text


def encodable(path: AnyPath) -> None:
    """Raise RecordingError where an experiment could not name a recording."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise RecordingError(f"{path}: its path is not UTF-8: no experiment could name it") from None


def draft_together(paths: Sequence[Path]) -> tuple[str | None, Survey]:
    """The same of several recordings of one drive, with the offsets of their clocks as far as they can be told."""
    from copem_replay.experiment.draft.clocks import clocks
    from copem_replay.experiment.draft.survey import survey
    from copem_replay.experiment.draft.template import commented, proposed, quoted
    from copem_replay.io.together import Together

    told = clocks(paths)
    ahead_s = [0.0, *(0.0 if one.offset.untold else round(one.offset.offset_s, 3) for one in told)]
    found = survey(Together(tuple(paths), tuple(ahead_s)))
    text = commented(found) if found.readable else proposed(found)
    if text is None:
        return None, found
    entry = [
        "logs:   # relative to this file, or absolute",
        f"  - together: [{', '.join(quoted(str(p)) for p in paths)}]",
    ]
    entry += ["    clock_offset_s:   # how far a clock is ahead of the first one's; it is subtracted"]
    for one, offset_s in zip(told, ahead_s[1:], strict=True):
        entry.append(f"      {quoted(str(one.path))}: {offset_s}   # {one.words()}; by {' and '.join(one.lists)}")
    lines = text.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("logs: ["))
    return "\n".join([*lines[:at], *entry, *lines[at + 1 :]]) + "\n", found


def draft_of(path: Path) -> tuple[str | None, Survey]:
    """The draft, None where no list of true objects is readable, and the survey it is made from."""
    from copem_replay.experiment.draft.survey import survey
    from copem_replay.experiment.draft.template import commented, proposed

    found = survey(path)
    return (commented(found) if found.readable else proposed(found)), found
