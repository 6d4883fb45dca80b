"""Facts: what the results say of a log beside its rows. With them a log whose pieces are all there is not read."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from copem_replay.core.time_chunk import WHOLE
from copem_replay.core.tracks import Scene, Solid
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.output_times import OutputTimes
from copem_replay.pipeline.list_rates import ListTimes, list_times
from copem_replay.pipeline.notes import oddities, same_instants
from copem_replay.pipeline.output_times import output_times

if TYPE_CHECKING:
    from copem_replay.pipeline.prepare import Replay


@dataclass(frozen=True)
class Facts:
    """Of one log in one experiment. `episodes`: rows of a run and configuration. `times`: as `list_times` has them.

    `listable`: states that a run draws for, by which the time it takes is estimated.
    """

    episodes: int
    same_instants: bool
    oddities: tuple[str, ...]
    times: dict[str, ListTimes]
    outputs: dict[str, OutputTimes]
    listable: int

    @classmethod
    def of(cls, recording: Recording, replay: Replay, experiment: Experiment) -> Self:
        """`experiment`: as it is for this log."""
        return cls(
            len(replay.episodes.object_ix),
            same_instants([replay]),
            tuple(oddities(replay, experiment, replay.ever_met)),
            list_times(replay, experiment),
            output_times([recording], experiment),
            len((replay.found(WHOLE) if replay.chunks == (WHOLE,) else replay.measured).tracks.frame_ix),
        )

    @classmethod
    def read(cls, said: dict[str, Any]) -> Self:
        """From JSON."""
        return cls(
            said["episodes"],
            said["same_instants"],
            tuple(said["oddities"]),
            {name: ListTimes.read(times) for name, times in said["times"].items()},
            {name: OutputTimes(**sums) for name, sums in said["outputs"].items()},
            said["listable"],
        )

    def as_json(self) -> dict[str, Any]:
        """As JSON has it."""
        said = asdict(self)
        for times in said["times"].values():
            if times["links"] is not None:
                times["links"] |= {name: times["links"][name].tolist() for name in ("from_s", "to_s")}
        return said


def scene_as_json(scene: Scene) -> dict[str, Any]:
    """A scene as JSON has it."""
    values = {f.name: getattr(scene, f.name) for f in fields(Scene)}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def scene_of(said: dict[str, Any]) -> Scene:
    """And back."""
    return Scene(
        **said
        | {
            "object_ids": tuple(said["object_ids"]),
            "object_class": np.array(said["object_class"], dtype=np.int8),
            "moving": np.array(said["moving"], dtype=bool),
            "solids": tuple(
                Solid(name, tuple((x, y) for x, y in corners), *rest) for name, corners, *rest in said["solids"]
            ),
        }
    )
