"""A PEM as an experiment has it: its couples, and what else its lists get wrong.

A list of couples is the short form, and is written again where nothing else is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, GetJsonSchemaHandler, SerializerFunctionWrapHandler, model_serializer, model_validator
from pydantic_core import CoreSchema

from copem_replay.core.components import Frozen
from copem_replay.perception.pem.condition import Couple

_OF_A_COUPLE = frozenset(Couple.model_fields) - {"memory"}


class Pem(Frozen):
    """A perception error model: ordered couples, the first that applies is used, and what else is wrong with lists."""

    couples: Annotated[tuple[Couple, ...], Field(min_length=1)]

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

    @model_serializer(mode="wrap")
    def _as_list(self, handler: SerializerFunctionWrapHandler) -> Any:
        written = handler(self)
        return written["couples"] if written.keys() == {"couples"} else written

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """JSON Schema: both forms."""
        found = handler(core_schema)
        return {"anyOf": [handler.resolve_ref_schema(found)["properties"]["couples"], found]}
