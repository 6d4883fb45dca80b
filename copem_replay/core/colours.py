"""Colours of configurations: the same everywhere, told apart by colour-blind readers.

Source: Okabe & Ito, "Color universal design" (2008), without black; the truth is grey.
"""

from __future__ import annotations

from collections.abc import Iterable

Rgb = tuple[int, int, int]
TRUTH: Rgb = (150, 150, 150)
_CYCLE: tuple[Rgb, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
)


def configuration_colours(configurations: Iterable[str]) -> dict[str, Rgb]:
    """A colour per configuration, in their order; past the seventh paler, then darker ones."""
    return {name: _shade(_CYCLE[k % len(_CYCLE)], k // len(_CYCLE)) for k, name in enumerate(configurations)}


def _shade(colour: Rgb, lap: int) -> Rgb:
    towards = 255 if lap % 2 else 0
    share = 0.55 * (1 - 0.5 ** ((lap + 1) // 2)) if lap else 0.0
    red, green, blue = (round(c + (towards - c) * share) for c in colour)
    return red, green, blue
