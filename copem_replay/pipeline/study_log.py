"""A log of a study: read and prepared where its objects are needed, else known by its cached facts.

The survey of a study's logs: each is read and checked before any run, and not all of them stay in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from copem_replay.core.components import Component
from copem_replay.core.errors import ExperimentError, RecordingError, RemoteFile
from copem_replay.experiment.drive import cache_last_experiment, resolve_for_log
from copem_replay.experiment.maps import MapFile
from copem_replay.experiment.schema import Experiment
from copem_replay.io.findings import Finding, as_finding
from copem_replay.io.ground_truth import truth_digest
from copem_replay.io.open import (
    DriveRecordings,
    Place,
    Stamps,
    check_files_unchanged,
    first_recording,
    read_file_stamps,
    sha256_of,
)
from copem_replay.io.recording import KnownLog, Recording
from copem_replay.pipeline.notes import LogFacts, scene_as_json, scene_from_json
from copem_replay.pipeline.parts import (
    PartCache,
    canonical_json,
    file_digests,
    own_components,
    recipe_key,
    take_fingerprint,
)
from copem_replay.pipeline.prepare import Replay, prepare_log

if TYPE_CHECKING:
    from copem_replay.pipeline.cost import Size

Stamp = tuple[object, ...]
_NOT_OF_A_SURVEY = ("logs", "show", "sweep")


@dataclass(frozen=True, kw_only=True, repr=False)
class StoredLog(KnownLog):
    """A log by its cached facts `said`; `read` reads its content when it is needed. `about`: the key of the facts."""

    said: Mapping[str, Any]
    read: Callable[[], Recording]
    about: str = ""


@dataclass
class StudyLog:
    """A log of a study. `experiment`: the study's. `ready`: the log prepared for it; None: not yet, or dropped."""

    recording: KnownLog
    experiment: Experiment
    parts: PartCache | None = None
    ready: Replay | None = None
    _whole: Recording | None = None  # the recording with its truth, until `drop`
    _facts: tuple[Experiment, LogFacts] | None = None  # of the last experiment that was asked for

    @property
    def name(self) -> str:
        """The name of the log."""
        return self.recording.scene.log

    @property
    def known(self) -> Mapping[str, Any] | None:
        """The cached facts of the log; None: its content is in memory."""
        return self.recording.said if isinstance(self.recording, StoredLog) else None

    def replay(self) -> Replay:
        """The prepared log."""
        if self.ready is None:
            self.ready = prepare_log(self.whole(), resolve_for_log(self.experiment, self.name))
        return self.ready

    def whole(self) -> Recording:
        """The recording with its truth and its lists."""
        log = self.recording
        if isinstance(log, Recording):
            return log
        if self._whole is None:
            assert isinstance(log, StoredLog)
            read = replace(log.read(), scene=log.scene, notes=log.notes)
            self._check_same(read, log.about)
            self._whole = read
        return self._whole

    def _check_same(self, read: Recording, key: str) -> None:
        """Raises RecordingError where the content differs from that of the cached facts, which are then removed."""
        if (sha := read_content_digest(read)) == self.digests["sha256"]:
            return
        if self.parts is not None and key:
            self.parts.forget(key)
        expected = self.digests["sha256"]
        raise RecordingError(
            f"expected the content that it had when it was read before, SHA-256 {expected[:12]}…, found {sha[:12]}…; "
            "run the command again, and it is replayed as it is now",
            path=first_recording(read.place),
        )

    def drop(self) -> None:
        """Drop from memory what can be read again; a recording that the survey holds stays."""
        if self.known is not None:
            self.ready = self._whole = None

    @cached_property
    def digests(self) -> Mapping[str, str]:
        """SHA-256 of the content, and of the truth."""
        if self.known is not None:
            return {name: self.known[name] for name in ("sha256", "truth")}
        return compute_log_digests(self.whole())

    @property
    def object_states(self) -> int:
        """Number of object states of the whole recording."""
        return self.whole().object_states if self.known is None else int(self.known["states"])

    @property
    def frames(self) -> int:
        """Number of lists of the truth."""
        return len(self.whole().truth.stamp_ns) if self.known is None else int(self.known["frames"])

    @cached_property
    def identity(self) -> dict[str, Any]:
        """The log's part of a recipe: its name, which is in the addresses of draws, and its content."""
        together = self.recording.together
        ahead_ns = [] if together is None else list(together.ahead_ns)
        named = {"name": self.name, "sha256": self.digests["sha256"], "topic": self.recording.topic}
        return named | {"ahead_ns": ahead_ns}

    def facts(self, experiment: Experiment) -> LogFacts:
        """The facts of the log that results state beside its rows, in an experiment; cached with the parts."""
        if self._facts is None or self._facts[0] is not experiment:
            self._facts = experiment, self._find_facts(resolve_for_log(experiment, self.name))
        return self._facts[1]

    def _find_facts(self, local: Experiment) -> LogFacts:
        """The facts of this log: from the cache if it has them for this recording, else of the replayed log."""
        if self.parts is None:
            return LogFacts.of(self.whole(), self.replay(), local)
        recording = self.recording
        seen = None if recording.stamps is None else _drop_paths(recording.stamps)
        key = survey_key(recording.place, local, seen)
        is_known = isinstance(recording, StoredLog) and recording.about == key
        stored = self.known if is_known else self.parts.known(key)
        if stored is not None and stored["scene"]["log"] == self.name:
            return LogFacts.read(stored["facts"])
        replay = self.replay()
        facts = LogFacts.of(self.whole(), replay, local)
        notes = [as_finding(note).as_json() for note in recording.notes]
        facts_json = {
            "scene": scene_as_json(recording.scene), "topic": recording.topic, "notes": notes,
            "host": recording.host_id, **self.digests, "states": self.object_states, "frames": self.frames,
            "facts": facts.as_json(),
        }  # fmt: skip
        self.parts.keep(key, facts_json)
        return facts


def compute_log_digests(recording: Recording) -> dict[str, Any]:
    """SHA-256 of the content of a recording that was read, and of its truth."""
    return {"sha256": read_content_digest(recording), "truth": truth_digest(recording.scene, recording.truth)}


def is_made(log: KnownLog) -> bool:
    """Whether the recording was made in memory, so that no file has it."""
    read = log.stamps is not None or log.sha256 is not None or not isinstance(log, Recording)
    return not read and isinstance(log.local, Path) and not log.local.exists()


def read_content_digest(recording: Recording) -> str:
    """SHA-256 of the content that was read; of a recording made in memory that of its truth.

    Raises RecordingError where the files have changed since.
    """
    if recording.sha256 is not None:
        return recording.sha256
    if is_made(recording):
        return truth_digest(recording.scene, recording.truth)
    digest = sha256_of(recording.local)
    check_files_unchanged(recording.stamps or ())
    return digest


def drop_content(recording: Recording, read: Callable[[], Recording]) -> StoredLog:
    """The facts of a recording without its content, which `read` reads again where it is needed."""
    said = {"states": recording.object_states, "frames": len(recording.truth.stamp_ns)}
    known = {one.name: getattr(recording, one.name) for one in fields(KnownLog)}
    return StoredLog(**known, said=compute_log_digests(recording) | said, read=read)


def survey_key(place: Place, experiment: Experiment, stamps: Sequence[Stamp] | None = None) -> str:
    """Cache key of a log's survey: its files and the experiment resolved for it, as canonical JSON.

    `stamps`: the stamps of the files when they were read; None: those that they have now.
    """
    common, components = _survey_parts(experiment)
    ahead_ns = place.ahead_ns if isinstance(place, DriveRecordings) else ()
    return canonical_json(
        {
            "files": file_stamps(place) if stamps is None else stamps,
            "ahead_ns": ahead_ns,
            "of": common,
            "own": file_digests(components, experiment.read),
        }
    )


@cache_last_experiment
def _survey_parts(experiment: Experiment) -> tuple[str, list[Component | MapFile]]:
    data = {key: value for key, value in experiment.as_written().items() if key not in _NOT_OF_A_SURVEY}
    of_all = recipe_key(canonical_json({"survey": 6, "fingerprint": take_fingerprint(), "experiment": data}))
    return of_all, own_components(experiment)


def file_stamps(place: Place) -> list[Stamp]:
    """The identity, the size and a stamp of the content of each file. Raises RecordingError, InputError."""
    if isinstance(place, RemoteFile):  # without a stamp no content is ever taken for the same
        return [(str(place), *(place.stamp or (uuid4().hex,)))]
    return _drop_paths(read_file_stamps(place))


def _drop_paths(files: Stamps) -> list[Stamp]:
    return [tuple(stamp[1:]) for stamp in files]  # the same files by any path


def recall_log(
    parts: PartCache, place: Place, experiment: Experiment, read: Callable[[], Recording]
) -> StoredLog | None:
    """A log from its cached facts, in an experiment that is resolved for it; None: none are cached."""
    try:
        key = survey_key(place, experiment)
    except RecordingError:  # reading the recording reports it
        return None
    if (facts := parts.known(key)) is None:
        return None
    first = first_recording(place)
    return StoredLog(
        scene=scene_from_json(facts["scene"]),
        path=Path(first.name) if isinstance(first, RemoteFile) else first,
        topic=facts["topic"],
        notes=tuple(Finding(*note) if isinstance(note, list) else note for note in facts["notes"]),
        host_id=facts["host"],
        together=place if isinstance(place, DriveRecordings) else None,
        remote=place if isinstance(place, RemoteFile) else None,
        said=facts,
        read=read,
        about=key,
    )


# The survey of a study's logs.

STATES_HELD = 250_000
"""Object states of logs that stay in memory from the survey on: some 20 drives of 20 s, 200 MB. The first log always
stays; others are read again when it is their turn. No result depends on it."""


class LogSurvey:
    """Reads and checks the logs of a study before any run. `sizes`: of the logs that are dropped.

    `began`: how many of their episodes began how. `problems`: why they have no closed form, where one is asked for.
    """

    def __init__(self, parts: PartCache | None = None) -> None:
        self.parts = parts
        self.sizes: list[Size] = []
        self.began: list[tuple[int, ...]] = []
        self.problems: list[str] = []
        self._states = 0

    def known(self, place: Place, experiment: Experiment, read: Callable[[], Recording]) -> KnownLog | None:
        """A log from its cached facts; None: it has to be read."""
        return None if self.parts is None else recall_log(self.parts, place, experiment, read)

    def kept(self, recording: Recording, experiment: Experiment, read: Callable[[], Recording]) -> KnownLog:
        """The log of a recording, with its content, or without truth and lists once many are in memory (`read` gets it
        again). Its SHA-256 is taken now, while its files are what was read. Raises ExperimentError, RecordingError.
        """
        recording = replace(recording, sha256=read_content_digest(recording))
        if not self._states or self._states + recording.object_states <= STATES_HELD:
            self._states += recording.object_states
            return recording
        # Imported here: only studies of many logs need them.
        from copem_replay.pipeline.closed_form import check_closed_form
        from copem_replay.pipeline.cost import estimate_size

        replay = prepare_log(recording, alone := experiment.model_copy(update={"logs": ()}))
        try:
            check_closed_form([replay], alone)
        except ExperimentError as error:
            self.problems += (problem for problem in error.problems if problem not in self.problems)
        self.sizes.append(estimate_size(replay))
        self.began.append(replay.episodes.count_began())
        return drop_content(recording, read)
