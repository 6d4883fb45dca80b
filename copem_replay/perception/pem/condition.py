"""The couples of a PEM: a condition, a detection model and an error model each; the first that applies is used.

Models do not know which of their draws last (`memory`): they are handed other numbers. docs/guide/perception-models.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError, ValidationError

from copem_replay.core.components import Either, Flag, Frozen, Id, NotNegative, Number, Share, Slot, TagText
from copem_replay.core.memory import Memory
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES, Bool, Float, Int, class_indices
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.pem.detection import DETECTION_MODELS, DetectionModel
from copem_replay.perception.pem.error import ERROR_MODELS, ErrorModel, find_noise_names

if TYPE_CHECKING:
    from copem_replay.core.memory import Parts


# Quantities that `memory` may name.

QUANTITIES = ("detection", "position", "yaw", "speed", "size", "class", "existence")
"""Quantities that any PEM may draw; models of the user's own may name others."""
_OF_SIZE = ("length", "width", "height")


def noise_quantity(noise: str) -> str:
    """The quantity that an error model's `noise(name)` belongs to: the first word of the name."""
    first = noise.partition(" ")[0]
    return "size" if first in _OF_SIZE else first


def check_quantities(memory: Mapping[str, Parts], noise_names: frozenset[str] | None, owner: str) -> None:
    """Raise pydantic's ValidationError for quantities in `memory` that nothing draws; `noise_names` None: unknown."""
    if noise_names is None:
        return
    drawn = ", ".join(sorted(noise_names)) or "none"
    problems = []
    for name in memory.keys() - noise_names - set(QUANTITIES):
        message = f'no model of this {owner} asks for noise "{name}" (they ask for {drawn})'
        kind = PydanticCustomError("memory", "{m}", {"m": message})
        problems.append(InitErrorDetails(type=kind, loc=("memory", name), input=name))
    if problems:
        raise ValidationError.from_exception_data("memory", sorted(problems, key=lambda problem: problem["loc"]))


# The existence that a unit claims.

_NODES = (1 - np.cos(np.linspace(0, np.pi, 1025))) / 2
"""Probabilities at which quantiles of a Beta distribution are tabulated, linear between: denser at the ends, where they
bend."""
_SUREST = 1e-6
"""No score is nearer to 0 or 1: so logarithms of densities and odds are finite."""

Shape = Annotated[float, Field(strict=True, ge=0.1, le=1000)]


class ExistenceScores(Frozen):
    """Beta distributions of the claimed existence of `real` objects and of a `ghost`: [a, b], mean a / (a + b).

    `calibrated: true`: the unit claims the probability that there is an object given the drawn number, for one real
    entry in a list beside the ghosts of the PEM. `false`: it claims the drawn number.
    """

    kind: Literal["scores"] = "scores"
    real: tuple[Shape, Shape]
    ghost: tuple[Shape, Shape]
    calibrated: Flag = False

    def claimed(self, uniform: Float, *, of_ghosts: bool, ghosts_in_list: float) -> Float:
        """Existence, as claimed, for uniforms in (0, 1) of any shape: of ghosts, or of real objects."""
        score = np.interp(uniform, _NODES, _beta_quantiles(*(self.ghost if of_ghosts else self.real)))
        score = np.clip(score, _SUREST, 1 - _SUREST)
        if not self.calibrated:
            return score
        if ghosts_in_list == 0:
            return np.full_like(score, 1 - _SUREST)
        from scipy.special import expit

        # One real entry to so many ghosts: the odds are 1 / ghosts_in_list before anything is drawn.
        odds = _log_beta_density(score, *self.real) - _log_beta_density(score, *self.ghost) - np.log(ghosts_in_list)
        claimed: Float = np.clip(expit(odds), _SUREST, 1 - _SUREST)
        return claimed


@lru_cache(64)
def _beta_quantiles(a: float, b: float) -> Float:
    """Quantiles of Beta(a, b) at `_NODES`."""
    from scipy.special import betaincinv

    table: Float = betaincinv(a, b, _NODES)
    return table


def _log_beta_density(x: Float, a: float, b: float) -> Float:
    """Logarithm of the density of Beta(a, b); `scipy.stats` has it, too, and takes .4 s to import."""
    from scipy.special import betaln, xlog1py, xlogy

    density: Float = xlog1py(b - 1.0, -x) + xlogy(a - 1.0, x) - betaln(a, b)
    return density


Claimed = Either[Share | Literal["visible_share"], ExistenceScores]
"""The existence that a unit claims: one value for all entries, the visible share, or drawn for each entry."""


_ON_THE_BOUND = 1e-9
"""Bounds are included; a value this far outside is on the bound (metres, radians, shares)."""


def check_ascending(value: tuple[float, float]) -> tuple[float, float]:
    """Validate that a range ends where it begins, or later."""
    if value[1] < value[0]:
        raise ValueError(f"expected [from, to] with from ≤ to, found {list(value)}")
    return value


def check_one_turn(value: tuple[float, float]) -> tuple[float, float]:
    """Validate that angles are within one turn."""
    beyond = [angle for angle in value if abs(angle) > 360]
    if beyond:
        raise ValueError(f"expected degrees from -360 to 360, found {beyond[0]:g} (through 0: [350, 10])")
    return value


def _check_class_name(value: str) -> str:
    if value not in CLASSES and value not in CLASS_GROUPS:
        known = ", ".join([*CLASSES, *CLASS_GROUPS])
        raise ValueError(f"expected one of {known}; found {value!r}")
    return value


ClassName = Annotated[str, AfterValidator(_check_class_name)]
ClassNames = Annotated[tuple[ClassName, ...], Field(min_length=1)]


class Condition(Frozen):
    """When a couple applies. All given keys must hold; bounds are included. `tags`: those that the log has."""

    range_m: Annotated[tuple[NotNegative, NotNegative], AfterValidator(check_ascending)] | None = None
    azimuth_deg: Annotated[tuple[Number, Number], AfterValidator(check_one_turn)] | None = None
    classes: ClassNames | None = None
    visible_share: Annotated[tuple[Share, Share], AfterValidator(check_ascending)] | None = None
    tags: Annotated[dict[Id, TagText] | None, Field(exclude_if=lambda tags: tags is None)] = None

    def applies_to(self, tags: Mapping[str, str]) -> bool:
        """Whether a log with these tags has all that are asked for."""
        return all(tags.get(name) == value for name, value in (self.tags or {}).items())

    def holds(self, view: ViewGeometry) -> Bool:
        """(P,) whether range, azimuth, class and visible share of each row meet the condition, whatever the tags."""
        result = np.ones(len(view.range_m), dtype=bool)
        if self.range_m is not None:
            result &= _is_within(view.range_m, *self.range_m)
        if self.azimuth_deg is not None:
            first, last = np.deg2rad(self.azimuth_deg)
            if last - first < 2 * np.pi - _ON_THE_BOUND:  # [150, −150] runs through 180
                span = np.mod(last - first, 2 * np.pi)
                turned = np.mod(view.azimuth_rad - first + _ON_THE_BOUND, 2 * np.pi)
                result &= turned <= span + 2 * _ON_THE_BOUND
        if self.classes is not None:
            result &= np.isin(view.class_ix, class_indices(self.classes))
        if self.visible_share is not None:
            result &= _is_within(view.visible_share, *self.visible_share)
        return result


def _is_within(value: Float, low: float, high: float) -> Bool:
    return (value >= low - _ON_THE_BOUND) & (value <= high + _ON_THE_BOUND)


class Couple(Frozen):
    """A detection and an error model that apply under a condition. Without `error` the state is exact.

    `existence`: the probability that there is an object, as the unit claims it: one value for all entries (0.9 is
    chosen), the visible share, or drawn for each entry (`scores`). `memory`: which draws last where this couple
    applies, instead of the PEM's memory.
    """

    when: Condition = Condition()
    detection: Annotated[DetectionModel, Slot("detection", DETECTION_MODELS)]
    error: Annotated[ErrorModel, Slot("error", ERROR_MODELS)] | None = None
    existence: Claimed = 0.9
    memory: Memory | None = Field(default=None, exclude_if=lambda memory: memory is None)

    @model_validator(mode="after")
    def _asked(self) -> Self:
        if self.memory is not None and self.memory.keys() - set(QUANTITIES):
            check_quantities(self.memory, self.asked(), "couple")
        return self

    def asked(self) -> frozenset[str] | None:
        """The quantities that its error model draws; None where one of the user's own does not say."""
        names = frozenset[str]() if self.error is None else find_noise_names(self.error)
        return None if names is None else frozenset(map(noise_quantity, names))


def find_couples(couples: tuple[Couple, ...], view: ViewGeometry, tags: Mapping[str, str] | None = None) -> Int:
    """(P,) index of the couple that applies to each row, −1 where none does (then it is not detected).

    `tags`: those of the log.
    """
    couple_ix = np.full(len(view.range_m), -1)
    for k, couple in enumerate(couples):
        if couple.when.applies_to(tags or {}):
            couple_ix[(couple_ix < 0) & couple.when.holds(view)] = k
    return couple_ix


def may_apply(couples: tuple[Couple, ...], view: ViewGeometry, tags: Mapping[str, str]) -> Bool:
    """(P,) where a couple applies at some visible share: that of the view is not read."""
    result = np.zeros(len(view.range_m), dtype=bool)
    for condition in (couple.when for couple in couples):
        if condition.applies_to(tags):
            result |= condition.model_copy(update={"visible_share": None}).holds(view)
    return result
