"""A PEM as an experiment has it: its couples, and what of their draws lasts.

A list of couples is the short form, and is written again where nothing else is said.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self

from pydantic import Field, GetJsonSchemaHandler, SerializerFunctionWrapHandler, model_serializer, model_validator
from pydantic_core import CoreSchema

from copem_replay.core.components import Frozen
from copem_replay.core.memory import Memory, Parts
from copem_replay.perception.pem.classes import Classes
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.pem.ghosts import Ghosts
from copem_replay.perception.pem.memory import QUANTITIES, check_names
from copem_replay.perception.pem.scores import Scores
from copem_replay.perception.pem.track_ids import TrackIds

_OF_A_COUPLE = frozenset(Couple.model_fields) - {"memory"}


class Pem(Frozen):
    """A perception error model: ordered couples, the first that applies is used, and the `memory` of their draws."""

    couples: Annotated[tuple[Couple, ...], Field(min_length=1)]
    memory: Memory = Field(default_factory=dict, exclude_if=lambda memory: not memory)
    ghosts: tuple[Ghosts, ...] = Field(default=(), exclude_if=lambda ghosts: not ghosts)
    classes: Classes | None = Field(default=None, exclude_if=lambda classes: classes is None)
    tracks: TrackIds | None = Field(default=None, exclude_if=lambda tracks: tracks is None)

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: object) -> object:
        if isinstance(value, list | tuple):
            return {"couples": value}
        one = isinstance(value, Mapping) and "couples" not in value and value.keys() & _OF_A_COUPLE
        if one or not isinstance(value, Mapping | cls):
            found = "nothing" if value is None else repr(value)
            found = found if len(found) <= 60 else found[:57] + "…"
            raise ValueError(f"expected a list, found {found}; of couples (each begins with `- `), or `couples: […]`")
        return value

    @model_validator(mode="after")
    def _asked(self) -> Self:
        if self.memory.keys() - set(QUANTITIES):
            check_names(self.memory, self.asked(), "PEM")
        return self

    @model_serializer(mode="wrap")
    def _as_list(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = handler(self)
        return written["couples"] if written.keys() == {"couples"} else written

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """JSON Schema: both forms."""
        found = handler(core_schema)
        return {"anyOf": [handler.resolve_ref_schema(found)["properties"]["couples"], found]}

    def asked(self) -> frozenset[str] | None:
        """The quantities that its error models draw; None where one of the user's own does not say."""
        each = [couple.asked() for couple in self.couples]
        return None if None in each else frozenset[str]().union(*(one for one in each if one is not None))

    def memory_of(self, couple: int) -> Mapping[str, Parts]:
        """What of a couple's draws lasts: as the couple says, or as the PEM does."""
        own = self.couples[couple].memory
        return self.memory if own is None else own

    @property
    def draws_claims(self) -> bool:
        """Whether claims of entries beside their states, or ghosts, are drawn."""
        return self._scores or bool(self.ghosts) or self.classes is not None or self.tracks is not None

    @property
    def _scores(self) -> bool:
        said = [*(couple.existence for couple in self.couples), *(sort.existence for sort in self.ghosts)]
        return any(isinstance(one, Scores) for one in said)

    @property
    def ghosts_in_list(self) -> float:
        """How many ghosts there are in a list on average; of those beside objects as if there were one object."""
        return sum(sort.in_list for sort in self.ghosts)

    @property
    def remembers(self) -> bool:
        """Whether anything lasts."""
        return any(self.memory_of(c) for c in range(len(self.couples)))

    def in_vain(self) -> Iterator[str]:
        """Quantities that are remembered and that no couple draws."""
        asked = self.asked()
        drawn = {"detection", *(asked or ())}
        drawn |= {"class"} if self.classes is not None and self.classes.confusion else set()
        drawn |= {"existence"} if self._scores else set()
        for name in self.memory if asked is not None else ():
            if name not in drawn:
                yield name
