"""One log of a study: read and made ready where its objects are needed, and else known from before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from copem_replay.core.components import Component
from copem_replay.core.errors import RecordingError
from copem_replay.core.remote import Remote
from copem_replay.core.tracks import TRUTH, VALUES, Tracks
from copem_replay.experiment.drive import for_all_logs, of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.checksum import Stamps, check_unchanged, sha256_of, stamps_of
from copem_replay.io.recording import Recording
from copem_replay.io.survey import Survey, whole
from copem_replay.io.together import Place, Together, first_of
from copem_replay.io.truth_digest import truth_digest
from copem_replay.pipeline.facts import Facts, scene_as_json, scene_of
from copem_replay.pipeline.pieces import Pieces
from copem_replay.pipeline.prepare import Replay, prepare
from copem_replay.pipeline.recipe import canonical, digests, fingerprint, key_of, own_components

Stamp = tuple[object, ...]
_NOT_OF_A_SURVEY = ("logs", "show", "sweep")


@dataclass
class StudyLog:
    """`experiment`: of the study, for which the log is made `ready`."""

    recording: Recording
    experiment: Experiment
    pieces: Pieces | None = None
    ready: Replay | None = None
    _whole: Recording | None = None  # while a log that does not stay in memory is there
    _facts: tuple[Experiment, Facts] | None = None  # those that were asked for last

    @property
    def name(self) -> str:
        """What the log is called."""
        return self.recording.scene.log

    def replay(self) -> Replay:
        """The log made ready."""
        if self.ready is None:
            self.ready = prepare(self.whole(), of_log(self.experiment, self.name))
        return self.ready

    def whole(self) -> Recording:
        """The recording with its truth and its lists."""
        if self._whole is None:
            read = whole(self.recording)
            self._check_same(read)
            self._whole = read
        return self._whole

    def _check_same(self, read: Recording) -> None:
        """Raise RecordingError where what was read again is not what is known, which is forgotten then."""
        survey = self.recording.survey
        if survey is None or (found := content_of(read)) == self.digests["sha256"]:
            return
        if self.pieces is not None and survey.about:
            self.pieces.forget(survey.about)
        known = self.digests["sha256"]
        raise RecordingError(
            f"expected the content that it had when it was read before, SHA-256 {known[:12]}…, found {found[:12]}…; "
            "run the command again, and it is replayed as it is now",
            path=first_of(read.place),
        )

    def drop(self) -> None:
        """Let go of what was read again: a log that stays in memory does, any other is read where it is needed."""
        if self.recording.survey is not None:
            self.ready = self._whole = None

    @cached_property
    def digests(self) -> Mapping[str, str]:
        """SHA-256 of the content, and of the truth."""
        if self.recording.survey is not None:
            return {name: self.recording.survey.said[name] for name in ("sha256", "truth")}
        return digests_of(self.recording)

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What of the log is in the recipes of its pieces: by its name draws are addressed."""
        together = self.recording.together
        ahead_ns = [] if together is None else list(together.ahead_ns)
        named = {"name": self.name, "sha256": self.digests["sha256"], "topic": self.recording.topic}
        return named | {"ahead_ns": ahead_ns}

    def facts(self, experiment: Experiment) -> Facts:
        """What the results say of the log beside its rows, in an experiment; kept for the next time."""
        if self._facts is None or self._facts[0] is not experiment:
            self._facts = experiment, self._found(of_log(experiment, self.name))
        return self._facts[1]

    def _found(self, alone: Experiment) -> Facts:
        if self.pieces is None:
            return Facts.of(self.whole(), self.replay(), alone)
        one, survey = self.recording, self.recording.survey
        seen = None if one.stamps is None else _named_by(one.stamps)
        about = survey_key(one.place, alone, seen)
        said = survey.said if survey is not None and survey.about == about else self.pieces.known(about)
        if said is not None and said["scene"]["log"] == self.name:
            return Facts.read(said["facts"])
        replay = self.replay()
        found = Facts.of(self.whole(), replay, alone)
        self.pieces.keep(about, self._survey() | {"facts": found.as_json()})
        return found

    def _survey(self) -> dict[str, Any]:
        one = self.recording
        said = {"scene": scene_as_json(one.scene), "topic": one.topic, "notes": list(one.notes), "host": one.host_id}
        return said | dict(self.digests)


def digests_of(recording: Recording) -> dict[str, str]:
    """SHA-256 of the content of a recording that was read, and of its truth."""
    return {"sha256": content_of(recording), "truth": truth_digest(recording.scene, recording.truth)}


def content_of(recording: Recording) -> str:
    """SHA-256 of what was read. Raises RecordingError where the files have changed since, so that nothing tells it."""
    if recording.sha256 is not None:
        return recording.sha256
    found = sha256_of(recording.local)
    check_unchanged(recording.stamps or ())
    return found


def dropped(recording: Recording, read: Callable[[], Recording]) -> Recording:
    """A recording without its truth and its lists, which are read again where they are needed."""
    survey = Survey(digests_of(recording), read)
    return replace(recording, truth=_nothing(), lists={}, around=None, lane_boundaries=(), survey=survey)


def survey_key(place: Place, experiment: Experiment, seen: Sequence[Stamp] | None = None) -> str:
    """All that is known of a log depends on: its files as they were `seen`, and the experiment, resolved for it.

    `seen`: None: as they are now.
    """
    of_all, own = _of_every_log(experiment)
    ahead_ns = place.ahead_ns if isinstance(place, Together) else ()
    return canonical(
        {"files": stamps(place) if seen is None else seen, "ahead_ns": ahead_ns, "of": of_all, "own": digests(own)}
    )


@for_all_logs
def _of_every_log(experiment: Experiment) -> tuple[str, list[Component]]:
    data = {key: value for key, value in experiment.as_written().items() if key not in _NOT_OF_A_SURVEY}
    of_all = key_of(canonical({"survey": 2, "fingerprint": fingerprint(), "experiment": data}))
    return of_all, own_components(experiment)


def stamps(place: Place) -> list[Stamp]:
    """Which files they are, their sizes, and what changes with their content. Raises RecordingError, InputError."""
    if isinstance(place, Remote):  # which is not asked for a content that it does not tell from another
        return [(str(place), *(place.stamp or (uuid4().hex,)))]
    return _named_by(stamps_of(place))


def _named_by(files: Stamps) -> list[Stamp]:
    return [tuple(one[1:]) for one in files]  # whatever path led to them


def known_log(pieces: Pieces, place: Place, experiment: Experiment, read: Callable[[], Recording]) -> Recording | None:
    """A recording as it is known from before, in an experiment that is resolved for it; None: it has to be read."""
    try:
        about = survey_key(place, experiment)
    except RecordingError:  # which is said when it is read
        return None
    if (said := pieces.known(about)) is None:
        return None
    together, remote = place if isinstance(place, Together) else None, place if isinstance(place, Remote) else None
    first = first_of(place)
    return Recording(
        scene_of(said["scene"]), _nothing(), Path(first.name) if isinstance(first, Remote) else first, said["topic"],
        tuple(said["notes"]), said["host"], together=together, remote=remote, survey=Survey(said, read, about),
    )  # fmt: skip


def _nothing() -> Tracks:
    """Tracks of no object."""
    none, values = np.empty(0, dtype=np.int64), np.empty((1, 0))
    return Tracks(
        (TRUTH,), np.zeros(1, dtype=np.int64), none, none, none, none, np.empty(0), none, values,
        np.empty((1, 0), dtype=bool), **dict.fromkeys(VALUES, values),
    )  # fmt: skip
