"""Existence scores: the existence that a unit claims, drawn for each entry, of real objects and of ghosts apart."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from copem_replay.core.components import Either, Flag, Frozen, Share
from copem_replay.core.tracks import Float

_NODES = (1 - np.cos(np.linspace(0, np.pi, 1025))) / 2
"""Where a Beta quantile is tabulated, linear between: denser at the ends, where it bends (chosen)."""
_SUREST = 1e-6
"""No score is nearer to 0 or 1 (chosen)."""

Shape = Annotated[float, Field(strict=True, ge=0.1, le=1000)]


class Scores(Frozen):
    """Beta distributions of the claimed existence of `real` objects and of a `ghost`: [a, b], mean a / (a + b).

    `calibrated: true`: the unit claims the probability that there is an object given the drawn number, for one real
    entry in a list beside the ghosts of the PEM. `false`: it claims the drawn number.
    """

    kind: Literal["scores"] = "scores"
    real: tuple[Shape, Shape]
    ghost: tuple[Shape, Shape]
    calibrated: Flag = False

    def claimed(self, uniform: Float, *, of_ghosts: bool, ghosts_in_list: float) -> Float:
        """Existence as claimed, of uniforms in (0, 1) of any shape, all of real objects or all `of_ghosts`."""
        drawn = np.interp(uniform, _NODES, _quantiles(*(self.ghost if of_ghosts else self.real)))
        drawn = np.clip(drawn, _SUREST, 1 - _SUREST)
        if not self.calibrated:
            return drawn
        if ghosts_in_list == 0:
            return np.full_like(drawn, 1 - _SUREST)
        from scipy.special import expit
        from scipy.stats import beta

        # One real entry to so many ghosts: the odds are 1 / ghosts_in_list before anything is drawn.
        odds = beta.logpdf(drawn, *self.real) - beta.logpdf(drawn, *self.ghost) - np.log(ghosts_in_list)
        claimed: Float = np.clip(expit(odds), _SUREST, 1 - _SUREST)
        return claimed


@lru_cache(64)
def _quantiles(a: float, b: float) -> Float:
    from scipy.stats import beta

    table: Float = beta.ppf(_NODES, a, b)
    return table


Claimed = Either[Share | Literal["visible_share"], Scores]
"""How probable a unit says that it is that there is an object: of each entry alike, as much as is seen, or drawn."""
