"""Colours and shapes of configurations by their place in the experiment, told apart by colour-blind readers.

One room for the viewer, figures, report, player, film and the layout of Foxglove. A configuration that is added at the
end changes no other one, unless both are shown and have one colour. The ground truth is grey and takes no place.
`tools/palette.py` has searched for the palettes, and says what it asks of them; tests hold them against it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Literal, NamedTuple

Rgb = tuple[int, int, int]
Theme = Literal["light", "dark"]
TRUTH: Rgb = (145, 145, 145)
"""Grey of the ground truth in both themes."""
_PALETTES: dict[Theme, str] = {
    "light": "3947fb 8d4f0c 25855b 3c023a 31079a 929300 3398c2 770a2e",
    "dark": "72a7ff f38906 4aefa7 ae4090 685bfc f4f521 39f3fc f6306c",
}
"""Colours by theme.

Any two are 15 or more apart (ΔE2000), for a deuteranope and a protanope, too, and from `TRUTH`. Contrast to white, or
to the dark grounds of viewer and report, is 3:1 or more.
"""
SHAPES = 7
"""Markers and dashes: as many as are told apart."""


class Sign(NamedTuple):
    """The sign of a configuration: its colour, and the number of its marker and dash (below `SHAPES`)."""

    colour: Rgb
    shape: int


def configuration_signs(
    configurations: Iterable[str], truths: Collection[str], theme: Theme = "dark"
) -> dict[str, Sign]:
    """One sign per configuration; `TRUTH` for the names in `truths`.

    `configurations`: all of an experiment in its order, shown or not, so that each keeps its sign. The first has a
    colour and a shape of its own; the others take turns of seven colours and six shapes, so that 43 differ. Nobody
    tells so many apart by colour: names stand beside them.
    """
    names = list(configurations)
    palette = [_read_colour(digits) for digits in _PALETTES[theme].split()]
    placed = [name for name in names if name not in truths] or names
    signs = {name: Sign(palette[_take_turn(k, len(palette))], _take_turn(k, SHAPES)) for k, name in enumerate(placed)}
    return {name: signs.get(name, Sign(TRUTH, 0)) for name in names}


def configuration_colours(
    configurations: Iterable[str], truths: Collection[str], theme: Theme = "dark", shown: Iterable[str] = ()
) -> dict[str, Rgb]:
    """The colours of `configuration_signs`; of those `shown` together a later one with a taken colour has another."""
    colours = {name: sign.colour for name, sign in configuration_signs(configurations, truths, theme).items()}
    placed = [name for name in shown if name not in truths]
    taken = [colours[name] for name in placed]
    free = [colour for colour in map(_read_colour, _PALETTES[theme].split()[1:]) if colour not in taken]
    for k, name in enumerate(placed):
        if free and taken[k] in taken[:k]:
            colours[name] = free.pop(0)
    return colours


def _take_turn(place: int, count: int) -> int:
    return 0 if place == 0 else 1 + (place - 1) % (count - 1)


def _read_colour(digits: str) -> Rgb:
    red, green, blue = bytes.fromhex(digits)
    return red, green, blue
