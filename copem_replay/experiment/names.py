"""What units and configurations may be called."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator

from copem_replay.core.components import Id


def _unit_name(value: str) -> str:
    if value in ("default", "truth", "all", ""):
        raise ValueError(f"{value!r} cannot be a unit's name")
    return value


def _configuration_name(value: str) -> str:
    # The name is part of topics and of entity paths.
    if not value or "/" in value or not value.isprintable():
        raise ValueError(f"expected a printable name without '/', found {value!r}")
    return value


UnitName = Annotated[Id, AfterValidator(_unit_name)]
ConfigurationName = Annotated[Id, AfterValidator(_configuration_name)]
