"""Colours of configurations, held against plain formulas of contrast and of differences between colours."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import pytest

from copem_replay.core.colours import MOST_COLOURS, REST, TRUTH, Rgb, Theme, configuration_colours
from tests.oracles.colour import ciede2000, contrast, lab, least_apart, linear

GROUNDS: dict[Theme, tuple[Rgb, ...]] = {
    "light": ((255, 255, 255), (250, 250, 250)),
    "dark": ((18, 19, 23), (27, 27, 27), (30, 30, 30)),
}
"""White paper and pages; the ground of the viewer, the dark page of the report, Foxglove's dark panels."""
THEMES: tuple[Theme, ...] = ("light", "dark")


def compositions(total: int) -> Iterator[tuple[int, ...]]:
    """All ways in which configurations may be of families, the families in any order."""
    if total == 0:
        yield ()
    for first in range(1, total + 1):
        for rest in compositions(total - first):
            yield (first, *rest)


def names_of(shape: tuple[int, ...]) -> list[str]:
    return [f"family {f}:{v}" for f, count in enumerate(shape) for v in range(count)]


SHAPES = [shape for total in range(1, MOST_COLOURS + 1) for shape in compositions(total)]


@pytest.mark.parametrize("theme", THEMES)
def test_colours_stay_apart_and_stand_out(theme: Theme) -> None:
    """Up to eight, of whatever families: from each other, from the truth, and from the ground; deuteranopes, too."""
    palettes = {tuple(configuration_colours(names_of(shape), theme=theme).values()) for shape in SHAPES}
    assert len(SHAPES) == 255
    for palette in palettes:
        for one, other in combinations((*palette, TRUTH), 2):
            assert least_apart(one, other) >= 15, (theme, one, other)
        for colour in palette:
            assert min(contrast(colour, ground) for ground in GROUNDS[theme]) >= 3, (theme, colour)


@pytest.mark.parametrize("theme", THEMES)
def test_no_colour_looks_grey(theme: Theme) -> None:
    """A chroma of 25 or more (CIELAB), unless it is nearly black, or nearly white in a family of more than four."""
    for shape in SHAPES:
        for colour in configuration_colours(names_of(shape), theme=theme).values():
            light, a, b = lab(linear(colour))
            excepted = light < 40 or (light > 80 and max(shape) > 4)
            assert (a**2 + b**2) ** 0.5 >= 25 or excepted, (theme, shape, colour)


@pytest.mark.parametrize("theme", THEMES)
def test_a_family_has_one_hue(theme: Theme) -> None:
    """Up to three variants within 40 degrees, and each lighter (or, on dark ground, darker) than the one before."""
    from math import atan2, degrees

    for shape in SHAPES:
        given = configuration_colours(names_of(shape), theme=theme)
        for f, count in enumerate(shape):
            seen = [lab(linear(given[f"family {f}:{v}"])) for v in range(count)]
            order = [light for light, _, _ in seen] if theme == "light" else [-light for light, _, _ in seen]
            assert order == sorted(order), (shape, f)
            hues = [degrees(atan2(b, a)) for _, a, b in seen]
            if count <= 3:
                turns = [abs((one - other + 180) % 360 - 180) for one, other in combinations(hues, 2)]
                assert max(turns, default=0) <= 40, (theme, shape, f, hues)


@pytest.mark.parametrize("theme", THEMES)
def test_beyond_eight_the_selected_have_colours(theme: Theme) -> None:
    names = [f"coPEM:{k}s" for k in range(12)]
    first = configuration_colours(names, theme=theme)
    assert [name for name, colour in first.items() if colour != REST] == names[:8]
    chosen = configuration_colours(names, selected=["coPEM:3s", "coPEM:11s"], theme=theme)
    assert [name for name, colour in chosen.items() if colour != REST] == ["coPEM:3s", "coPEM:11s"]
    assert least_apart(REST, TRUTH) >= 15
    assert min(contrast(REST, ground) for ground in GROUNDS[theme]) >= 3


@pytest.mark.parametrize("theme", THEMES)
def test_the_truth_is_grey_and_takes_no_place(theme: Theme) -> None:
    names = ["PEM", "coPEM:0s", "coPEM:1s"]
    with_truth = configuration_colours(["GT", *names], truths=["GT"], theme=theme)
    assert with_truth == {"GT": TRUTH} | configuration_colours(names, theme=theme)
    assert len(set(TRUTH)) == 1
    alone = configuration_colours(["GT:0s", "GT:1s"], truths=["GT:0s", "GT:1s"], theme=theme)
    assert TRUTH not in alone.values(), "nothing else to be told from"
    assert min(contrast(TRUTH, ground) for ground in GROUNDS[theme]) >= 3


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [  # of the 34 pairs that Sharma, Wu and Dalal publish for implementations
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0000),
        ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((50.0, 2.5, 0.0), (56.0, -27.0, -3.0), 31.9030),
        ((22.7233, 20.0904, -46.694), (23.0331, 14.973, -42.5619), 2.0373),
        ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_oracle_against_published_differences(
    one: tuple[float, ...], other: tuple[float, ...], expected: float
) -> None:
    assert ciede2000(one, other) == pytest.approx(expected, abs=1e-4)
