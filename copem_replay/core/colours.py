"""Colours of configurations: one for each in all figures, told apart by colour-blind readers.

Source: Okabe & Ito, "Color universal design" (2008), without black; the truth is grey.
"""

from __future__ import annotations

from collections.abc import Iterable

Rgb = tuple[int, int, int]
TRUTH: Rgb = (150, 150, 150)
DARKEST = 0.14
"""Least relative luminance of a configuration's colour: contrast 3:1 (WCAG 2.1) to grounds as dark as luminance
0.013."""
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
    """A colour per configuration, by its place; past the seventh paler, then darker ones.

    `configurations`: all of an experiment, in its order, whichever of them are shown: so each keeps its colour.
    """
    return {name: _shade_colour(_CYCLE[k % len(_CYCLE)], k // len(_CYCLE)) for k, name in enumerate(configurations)}


def relative_luminance(colour: Rgb) -> float:
    """Relative luminance, 0 to 1. Source: WCAG 2.1."""
    red, green, blue = (c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in colour))
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _shade_colour(colour: Rgb, lap: int) -> Rgb:
    share = 0.55 * (1 - 0.5 ** ((lap + 1) // 2)) if lap else 0.0
    shaded = _mix_colours(colour, 255 if lap % 2 else 0, share)
    while relative_luminance(shaded) < DARKEST:
        shaded = _mix_colours(shaded, 255, 0.05)
    return shaded


def _mix_colours(colour: Rgb, end: int, share: float) -> Rgb:
    red, green, blue = (round(c + (end - c) * share) for c in colour)
    return red, green, blue
