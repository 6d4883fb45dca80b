"""Where the couples of a PEM apply, as outlines in the unit's own frame: for drawing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.perception.pem.condition import Condition, Couple

_ARC_STEP_RAD = np.deg2rad(3)  # chosen: a chord at 80 m is 3 cm off the arc


def outlines(pem: Sequence[Couple]) -> list[Float]:
    """Borders (K, 2) of where the couples of a PEM apply, m, ahead along x; none for a couple that ends nowhere."""
    fields = dict.fromkeys((c.when.range_m, c.when.azimuth_deg) for c in pem)
    return [border for field in fields for border in _outline(Condition(range_m=field[0], azimuth_deg=field[1]))]


def _outline(when: Condition) -> list[Float]:
    if when.range_m is None:
        return []
    near_m, far_m = when.range_m
    first, last = np.deg2rad(when.azimuth_deg or (-180.0, 180.0))
    all_around = last - first >= 2 * np.pi - 1e-9
    span = 2 * np.pi if all_around else np.mod(last - first, 2 * np.pi)
    angle = first + np.linspace(0, span, int(np.ceil(span / _ARC_STEP_RAD - 1e-9)) + 1)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if all_around:
        return [radius_m * arc for radius_m in (near_m, far_m) if radius_m > 0]
    inner = near_m * (arc[::-1] if near_m > 0 else arc[:1])
    return [np.concatenate([inner[-1:], far_m * arc, inner])]
