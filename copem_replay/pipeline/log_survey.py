"""The survey of a study's logs: each is read and checked before any run, and not all of them stay in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from copem_replay.core.errors import ExperimentError

if TYPE_CHECKING:  # what is wrong with an experiment is said before all that is loaded
    from copem_replay.experiment.schema import Experiment
    from copem_replay.io.recording import Recording
    from copem_replay.io.together import Place
    from copem_replay.pipeline.memory import Size
    from copem_replay.pipeline.pieces import Pieces

STATES_HELD = 250_000
"""Object states of logs that stay in memory from the survey on (chosen: some 20 drives of 20 s, 200 MB); the first
does however long it is. All others are read again when it is their turn."""


class LogSurvey:
    """`sizes`: of the logs that were dropped. `problems`: why they have no closed form, where one is asked for."""

    def __init__(self, pieces: Pieces | None = None) -> None:
        self.pieces = pieces
        self.sizes: list[Size] = []
        self.problems: list[str] = []
        self._states = 0

    def known(self, place: Place, experiment: Experiment, read: Callable[[], Recording]) -> Recording | None:
        """A recording as it is known from before; None: it has to be read."""
        if self.pieces is None:
            return None
        from copem_replay.pipeline.study_log import known_log

        return known_log(self.pieces, place, experiment, read)

    def kept(self, recording: Recording, experiment: Experiment, read: Callable[[], Recording]) -> Recording:
        """A recording that was read, in the experiment as it is for this log: in memory, or what is left of it there.

        Its SHA-256 is taken now, while its files are what was read. Raises ExperimentError, RecordingError.
        """
        from copem_replay.pipeline.study_log import content_of

        recording = replace(recording, sha256=content_of(recording))
        if not self._states or self._states + recording.object_states <= STATES_HELD:
            self._states += recording.object_states
            return recording
        from copem_replay.pipeline.memory import size_of
        from copem_replay.pipeline.prepare import prepare
        from copem_replay.pipeline.run import check_closed_form
        from copem_replay.pipeline.study_log import dropped

        replay = prepare(recording, alone := experiment.model_copy(update={"logs": ()}))
        try:
            check_closed_form([replay], alone)
        except ExperimentError as error:
            self.problems += (problem for problem in error.problems if problem not in self.problems)
        self.sizes.append(size_of(replay))
        return dropped(recording, read)
