"""Track ids: the identity that a unit keeps of what it lists, until it loses it and gives another."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from copem_replay.core.components import Frozen


class TrackIds(Frozen):
    """A unit keeps an id of each object, `lasts_s` on average until it switches to a new one (exponential).

    Objects never swap ids.
    """

    lasts_s: Annotated[float, Field(strict=True, ge=0.001, le=86_400)]
