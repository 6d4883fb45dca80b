"""Recordings in Python: read, surveyed, and the draft of an experiment that replays one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import Scene, Tracks
from copem_replay.io.recording import Recording
from copem_replay.io.window import WindowSeconds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from copem_replay.api.study import AnyExperiment, AnyPath
    from copem_replay.core.site_map import SiteMap
    from copem_replay.experiment.draft.findings import RecordingSurvey
    from copem_replay.io.config import EgoTopic


def read_recordings(experiment: AnyExperiment) -> list[Recording]:
    """Read the recordings an experiment names, with its ego, topic, window and recorded units.

    Every recording gets a name of its own, `scene.log`: that of its file, with its folder where two are alike.

    Raises InputError with all problems at once: of the experiment, of each recording, and of both together.

    >>> [recording.scene.log for recording in cr.read_recordings("logs/tc016d.yaml")]
    ['tc016d']
    """
    from copem_replay.api.study import make_study

    return list(make_study(experiment).recordings)


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
    from copem_replay.io.open import name_log
    from copem_replay.io.recording import read_log

    return read_log(Path(path), name=name_log(Path(path)), ego=ego, topic=topic, window_s=window_s)


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
    from copem_replay.io.recorded_lists import read_sensor_data

    return read_sensor_data(Path(path), topic, scene)


def compare_with_map(path: AnyPath, map_path: AnyPath) -> list[str]:
    """Lines on how well the lanes of a map agree with the traffic of a recording, and on the shift that is best.

    A map in degrees is placed by what the recording says of its place; metres are taken for the recording's. Nothing
    is moved. Raises InputError.
    """
    import numpy as np

    from copem_replay.core.errors import InputError, count_noun
    from copem_replay.core.extras import load_extra
    from copem_replay.metrics.agreement import estimate_shift, find_agreement

    recording, name = read_recording(path), os.path.basename(map_path)
    site: SiteMap = load_extra("reader", "map")(Path(map_path))
    how = "taken as in the frame of the log"
    if site.degrees:
        if recording.place_said is None:
            raise InputError(f"{map_path}: its places are degrees, and the recording does not say where it is")
        frame, _ = recording.place_said.read()
        site, how = site.moved(lambda degrees: frame.from_wgs84(degrees[:, ::-1])), "placed by what the recording says"
    found = f"{count_noun(len(site.lanes), 'lane')}, {count_noun(len(site.areas), 'area')}"
    lines = [f"map {name}: {found}, {count_noun(len(site.solids), 'solid')}; {how}"]
    if site.lanes:
        truth = recording.truth
        borders = np.concatenate([line[:, :2] for lane in site.lanes for line in (lane.left_m, lane.right_m)])
        middles = (np.median(borders, axis=0), np.median(np.stack([truth.x_m[0], truth.y_m[0]], axis=1), axis=0))
        lines.append(f"map {name}: {find_agreement(recording.scene, truth, site.lanes).words}")
        if (apart_m := float(np.hypot(*(middles[0] - middles[1])))) > np.hypot(*np.ptp(borders, axis=0)):
            lines.append(f"map {name}: its middle is {apart_m / 1000:.3g} km from the traffic's: not in the same frame")
        elif (shift := estimate_shift(recording.scene, truth, site.lanes)) is not None:
            lines.append(f"map {name}: {shift.words}")
    return lines


def inspect_recording(path: AnyPath) -> dict[str, Any]:
    """Survey a recording: topics, true objects, lists of units, span in seconds, rates in Hz, ego, what is missing.

    The result is plain data, as of `copem-replay info --json`. A recording that cannot be read raises nothing:
    `readable` is then False, and `reason` says why.

    >>> found = cr.inspect_recording("logs/tc016d.mcap")
    >>> found["readable"], [topic["role"] for topic in found["topics"]]
    (True, ['truth'])
    """
    from copem_replay.experiment.draft.findings import survey_as_json
    from copem_replay.experiment.draft.survey import survey_recording

    return survey_as_json(survey_recording(Path(path)))


def draft_experiment(path: AnyPath, *more: AnyPath) -> str:
    """Draft an experiment that replays a recording, or several drives: YAML with comments.

    Its paths are relative to the working folder. The text is what `copem-replay init` prints. Ego, a mast and recorded
    units are guesses, each with a comment.

    Raises RecordingError where no list of true objects is readable in one of them, where a path is not UTF-8, or where
    one is given twice.

    >>> print(cr.draft_experiment("logs/tc016d.mcap").splitlines()[0])
    # Replays tc016d.mcap, 8.0 s: 2 pedestrian, 1 bicycle, 4 car, 1 truck.
    """
    paths = [Path(one) for one in (path, *more)]
    text, surveys = draft_drives(paths)
    if text is None:
        raise RecordingError(explain_undrafted(surveys))
    return text


def check_encodable(path: AnyPath) -> None:
    """Raise RecordingError for a path that is not UTF-8, which no experiment file can hold."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise RecordingError(f"{path}: its path is not UTF-8: no experiment could name it") from None


def draft_joint_recordings(paths: Sequence[Path]) -> tuple[str | None, list[RecordingSurvey]]:
    """The draft for several recordings of one drive, with their clock offsets, 0 where none can be estimated.

    Returns the text, None where no list of true objects is readable, and the joint survey, alone in a list.
    """
    from copem_replay.experiment.draft.survey import compare_clocks, survey_recording
    from copem_replay.experiment.draft.template import format_draft, quote_yaml, take_proposal
    from copem_replay.io.open import DriveRecordings

    for path in paths:
        check_encodable(path)
    clocks = compare_clocks(paths)
    ahead_s = [0.0, *(0.0 if clock.offset.untold else round(clock.offset.offset_s, 3) for clock in clocks)]
    survey = survey_recording(DriveRecordings(tuple(paths), tuple(ahead_s)))
    drafted = take_proposal(survey)
    if drafted is None:
        return None, [survey]
    entry = [
        "logs:   # relative to this file, or absolute",
        f"  - together: [{', '.join(quote_yaml(str(p)) for p in paths)}]",
    ]
    entry += ["    clock_offset_s:   # how far a clock is ahead of the first one's; it is subtracted"]
    for clock, offset_s in zip(clocks, ahead_s[1:], strict=True):
        lists = " and ".join(clock.lists)
        entry.append(f"      {quote_yaml(str(clock.path))}: {offset_s}   # {clock.words()}; by {lists}")
    lines = format_draft(drafted).splitlines()
    logs_line = next(k for k, line in enumerate(lines) if line.startswith("logs: ["))
    return "\n".join([*lines[:logs_line], *entry, *lines[logs_line + 1 :]]) + "\n", [survey]


def draft_drives(paths: Sequence[Path]) -> tuple[str | None, list[RecordingSurvey]]:
    """The draft for recordings of one drive each, None where one has no readable list of true objects; the surveys.

    Raises RecordingError for a path that is not UTF-8, and for a recording that is given twice.
    """
    from copem_replay.experiment.draft.survey import survey_recording
    from copem_replay.experiment.draft.template import format_draft, take_proposal

    given: dict[str, Path] = {}
    for path in paths:
        check_encodable(path)
        first = given.setdefault(os.path.realpath(path), path)
        if first is not path:
            also = "" if str(first) == str(path) else f", as {first}, too"
            raise RecordingError(f"expected each recording once, found it twice{also}", path=path)
    surveys = [survey_recording(path) for path in paths]
    drafted = [one for survey in surveys if (one := take_proposal(survey)) is not None]
    return (format_draft(*drafted) if len(drafted) == len(surveys) else None), surveys


def explain_undrafted(surveys: Sequence[RecordingSurvey]) -> list[str]:
    """A line for each recording that cannot be drafted."""
    from copem_replay.experiment.draft.template import take_proposal

    return [one.reason or f"{one.log}: no list of true objects" for one in surveys if take_proposal(one) is None]
