"""Errors of a unit beside its PEM: its own pose, its clock, and outages. Keys.

What comes of them: `pose_error.py`, `clock.py`, `outages.py`. docs/guide/unit-errors.md.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from copem_replay.core.components import Flag, Frozen, NotNegative
from copem_replay.core.memory import Part, Parts


class PoseError(Frozen):
    """Errors of a unit's own position and heading, from mounting or localisation.

    `position_sigma_m` applies to easting and to northing, `yaw_sigma_deg` to the heading. `memory`: the parts that
    last, for the unit, or with `of: all` shared by all units; the rest is new in every list. `stated`: the unit's
    stated covariances include these errors.
    """

    position_sigma_m: NotNegative = 0.0
    yaw_sigma_deg: NotNegative = 0.0
    stated: Flag = False
    memory: Parts | None = Field(default=None, exclude_if=lambda memory: memory is None)

    @field_validator("memory")
    @classmethod
    def _of_units(cls, parts: tuple[Part, ...] | None) -> tuple[Part, ...] | None:
        if any(part.of == "object" for part in parts or ()):
            raise ValueError("of: object: a pose is of no object; expected unit or all")
        return parts

    @property
    def parts(self) -> tuple[Part, ...]:
        """What lasts: of the unit where nothing else is said."""
        return tuple(p.model_copy(update={"of": "unit"}) if p.of == "pair" else p for p in self.memory or ())


class Clock(Frozen):
    """Errors of a unit's clock: offset, and drift since the log's start, as standard deviations over the runs.

    Within a run both are constant. A fusion sees captures in this clock.
    """

    offset_sigma_s: NotNegative = 0.0
    drift_sigma_ppm: NotNegative = 0.0


class Outages(Frozen):
    """Times without lists: `down_share` of the time, each for `lasts_s` on average."""

    down_share: Annotated[float, Field(strict=True, ge=0, le=0.999)]
    lasts_s: Annotated[float, Field(strict=True, ge=0.001, le=86_400)]

    @property
    def correlation_s(self) -> float:
        """Of the number that decides: down while it is below `down_share`, which ends at a renewal above.

        Renewals come every `correlation_s` on average, and 1 − `down_share` of them are above: after `lasts_s`.
        """
        return self.lasts_s * (1 - self.down_share)
