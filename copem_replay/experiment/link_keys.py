"""Links: keys of an experiment file."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Discriminator, Field, Tag

from copem_replay.communication.link import LINKS, LinkModel
from copem_replay.core.components import Id, Slot


def _link_name(value: str) -> str:
    if value in ("none", "default", ""):
        raise ValueError(f"{value!r} cannot be a link's name")
    return value


def _what_link(value: object) -> str:
    if isinstance(value, LinkModel) or (isinstance(value, dict) and "kind" in value):
        return "link"
    return "by unit" if isinstance(value, dict) else "name"


LinkName = Annotated[Id, AfterValidator(_link_name)]
AnyLink = Annotated[LinkModel, Slot("link", LINKS, "radio")]
LinkOf = Annotated[
    Annotated[AnyLink, Tag("link")] | Annotated[Id, Tag("name")] | Annotated[dict[Id, Id], Tag("by unit")],
    Discriminator(_what_link),
]
"""A link: by its name, by unit with `default`, or as it is."""
IssueRate = Annotated[float, Field(strict=True, ge=0.001, le=1000)]
"""Fused lists per second."""
