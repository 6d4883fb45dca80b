"""What is otherwise for one log: keys of an entry of `logs`."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    field_validator,
    model_serializer,
    model_validator,
)

from copem_replay.core.components import Frozen, Id, Number
from copem_replay.io.config import Ego, HowRead, WindowOf
from copem_replay.perception.config import Obstacle

MEASURED_PER_LOG = ("objects", "onset", "distance_to", "annotated")
"""Keys of `measure` that a log may have its own of; the others say what the tables of all logs have in common."""


class LogSettings(Frozen):
    """A recording, and what is otherwise for it: keys that are given replace those of the experiment, lists whole.

    `file`: as a plain entry, wildcards too. `name`: what the log is called, by default as its file. Of `units` and
    `measure` single keys are replaced; `null` in the place of a unit: the log lacks it. `together`, in the place of
    `file`: several recordings of one drive; `clock_offset_s`: how far the clock of one is ahead of the first one's.
    """

    file: Annotated[str, Field(min_length=1)] | None = None
    together: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=2)] | None = None
    clock_offset_s: dict[str, Number] = Field(default_factory=dict)
    name: Annotated[Id, Field(min_length=1)] | None = None
    ego: Ego | None = None
    window_s: WindowOf | None = None
    units: dict[Id, dict[str, Any] | None] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] | None = None
    read: HowRead | None = None
    measure: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.file is None) == (self.together is None):
            raise ValueError("expected one of `file: <recording>` and `together: [<recording>, <recording>]`")
        paths = self.together or ()
        if len(set(paths)) < len(paths):
            raise ValueError(f"together: expected each recording once, found {max(paths, key=paths.count)!r} twice")
        for name, offset_s in self.clock_offset_s.items():
            if name not in paths:
                expected = ", ".join(paths[1:]) or "none without `together`"
                raise ValueError(f"clock_offset_s: expected a recording of `together` ({expected}), found {name!r}")
            if name == paths[0] and offset_s:
                raise ValueError(f"clock_offset_s: {name!r} is the first, by whose clock the others are ahead")
        return self

    @field_validator("measure")
    @classmethod
    def _of_a_log(cls, measure: dict[str, Any]) -> dict[str, Any]:
        for key in measure:
            if key not in MEASURED_PER_LOG:
                names = ", ".join(MEASURED_PER_LOG)
                raise ValueError(f"{key}: goes for all logs alike; a log has its own {names}")
        return measure

    @model_serializer(mode="wrap")
    def _as_given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only keys that are given: a `null` would be one, too."""
        written: dict[str, Any] = write(self)
        return {key: value for key, value in written.items() if key in self.model_fields_set}


def _what_log(value: object) -> str:
    return "settings" if isinstance(value, dict | LogSettings) else "path"


LogEntry = Annotated[Annotated[str, Tag("path")] | Annotated[LogSettings, Tag("settings")], Discriminator(_what_log)]
"""A path, with wildcards or not, or a mapping with settings."""
