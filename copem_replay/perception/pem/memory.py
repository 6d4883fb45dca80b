"""Memory of a PEM: which of its draws last, for how long, and which rows share them. Keys of the experiment file.

Models do not know of it: what changes is which numbers they are handed. docs/guide/perception-models.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pydantic_core import InitErrorDetails, PydanticCustomError, ValidationError

if TYPE_CHECKING:
    from copem_replay.core.memory import Parts

QUANTITIES = ("detection", "position", "yaw", "speed", "size", "class", "existence")
"""What any PEM may have drawn; models of the user's own have names of their own besides."""
_OF_SIZE = ("length", "width", "height")


def quantity_of(noise: str) -> str:
    """The quantity that an error model's `noise(name)` belongs to: the first word of the name."""
    first = noise.partition(" ")[0]
    return "size" if first in _OF_SIZE else first


def check_names(memory: Mapping[str, Parts], asked: frozenset[str] | None, owner: str) -> None:
    """Raise pydantic's ValidationError, at the name, for quantities that nothing draws; `asked` None: not known."""
    if asked is None:
        return
    there = ", ".join(sorted(asked)) or "none"
    problems = []
    for name in memory.keys() - asked - set(QUANTITIES):
        message = f'no model of this {owner} asks for noise "{name}" (they ask for {there})'
        kind = PydanticCustomError("memory", "{m}", {"m": message})
        problems.append(InitErrorDetails(type=kind, loc=("memory", name), input=name))
    if problems:
        raise ValidationError.from_exception_data("memory", sorted(problems, key=lambda one: one["loc"]))
