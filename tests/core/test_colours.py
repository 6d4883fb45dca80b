"""Colours of configurations, held against plain formulas of contrast and of differences between colours."""

from __future__ import annotations

from itertools import combinations
from math import atan2, degrees

import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.colours import TRUTH, Rgb, Theme, configuration_colours, configuration_signs
from tests.oracles.colour import ciede2000, contrast, lab, least_apart, linear

GROUNDS: dict[Theme, tuple[Rgb, ...]] = {
    "light": ((255, 255, 255), (250, 250, 250)),
    "dark": ((18, 19, 23), (27, 27, 27), (30, 30, 30)),
}
"""White paper and pages; the ground of the viewer, the dark page of the report, Foxglove's dark panels."""
THEMES: tuple[Theme, ...] = ("light", "dark")


NAMES = [f"c{k}" for k in range(60)]


@pytest.mark.parametrize("theme", THEMES)
def test_colours_stay_apart_and_stand_out(theme: Theme) -> None:
    """Eight: from each other, from the truth, and from the ground; for deuteranopes and protanopes, too."""
    palette = configuration_colours(NAMES[:8], (), theme).values()
    for one, other in combinations((*palette, TRUTH), 2):
        assert least_apart(one, other) >= 15, (one, other)
    for colour in (*palette, TRUTH):
        assert min(contrast(colour, ground) for ground in GROUNDS[theme]) >= 3, colour


@pytest.mark.parametrize("theme", THEMES)
def test_no_colour_looks_grey(theme: Theme) -> None:
    """A chroma of 25 or more (CIELAB)."""
    for colour in configuration_colours(NAMES[:8], (), theme).values():
        _, a, b = lab(linear(colour))
        assert (a**2 + b**2) ** 0.5 >= 25, colour


def test_a_place_has_one_hue_in_both_themes() -> None:
    """Within 45 degrees in CIELAB."""
    for name in NAMES[:8]:
        hues = []
        for theme in THEMES:
            _, a, b = lab(linear(configuration_colours(NAMES, (), theme)[name]))
            hues.append(degrees(atan2(b, a)))
        assert abs((hues[0] - hues[1] + 180) % 360 - 180) <= 45, (name, hues)


@given(st.integers(1, 30), st.integers(1, 30), st.sets(st.integers(0, 59)), st.sampled_from(THEMES))
def test_one_that_is_added_at_the_end_changes_no_other(count: int, more: int, truths: set[int], theme: Theme) -> None:
    """Unless all before it are the truth, which is grey beside others alone."""
    grey = {NAMES[k] for k in truths}
    before = configuration_signs(NAMES[:count], grey, theme)
    if set(NAMES[:count]) <= grey:
        return
    after = configuration_signs(NAMES[: count + more], grey, theme)
    assert {name: after[name] for name in before} == before


def test_many_differ_by_colour_and_shape_and_the_first_from_all() -> None:
    signs = list(configuration_signs(NAMES[:43], ()).values())
    assert len(set(signs)) == 43
    assert [sign.shape for sign in signs[:9]] == [0, 1, 2, 3, 4, 5, 6, 1, 2]
    assert all(sign.colour != signs[0].colour and sign.shape != 0 for sign in signs[1:])
    # Seven in a row, and the first besides: what one file of the viewer holds.
    for k in range(1, 37):
        assert len({signs[0].colour, *(sign.colour for sign in signs[k : k + 7])}) == 8


@pytest.mark.parametrize("theme", THEMES)
def test_the_truth_is_grey_and_takes_no_place(theme: Theme) -> None:
    names = ["PEM", "coPEM:0s", "coPEM:1s"]
    with_truth = configuration_colours(["GT", *names], ["GT"], theme)
    assert with_truth == {"GT": TRUTH} | configuration_colours(names, (), theme)
    assert len(set(TRUTH)) == 1
    alone = configuration_colours(["GT:0s", "GT:1s"], ["GT:0s", "GT:1s"], theme)
    assert TRUTH not in alone.values(), "nothing else to be told from"


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


@given(st.lists(st.integers(0, 59), unique=True, max_size=7), st.integers(0, 59), st.sampled_from(THEMES))
def test_seven_shown_together_differ_and_only_those_change_whose_colour_is_taken(
    places: list[int], truth: int, theme: Theme
) -> None:
    shown, grey = [NAMES[k] for k in places], {NAMES[truth]}
    of_all = configuration_colours(NAMES, grey, theme)
    colours = configuration_colours(NAMES, grey, theme, shown)
    mine = [colours[name] for name in shown if name not in grey]
    assert len(set(mine)) == len(mine)
    for k, name in enumerate(shown):
        before = [of_all[other] for other in shown[:k] if other not in grey]
        if of_all[name] not in before or name in grey:
            assert colours[name] == of_all[name]
        else:
            assert colours[name] in configuration_colours(NAMES[1:9], (), theme).values()
            assert colours[name] != configuration_colours(NAMES, (), theme)[NAMES[0]], "that of the first is its own"
    assert {name: colours[name] for name in NAMES if name not in shown} == {
        name: of_all[name] for name in NAMES if name not in shown
    }
