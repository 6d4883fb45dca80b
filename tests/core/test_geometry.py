"""Overlap of boxes against areas computed by hand, against Shapely, and under what must not matter."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from copem_replay.core.geometry import count_below, rotated_iou

count_below, rotated_iou = map(njit, (count_below, rotated_iou))  # as kernels call them

Box = tuple[float, float, float, float, float]
"""x, y, yaw, length, width."""

QUARTER = math.pi / 2
places = st.floats(-6.0, 6.0) | st.integers(-3, 3).map(float)
yaws = st.floats(-7.0, 7.0) | st.sampled_from([k * QUARTER for k in range(-4, 5)])
sizes = st.floats(0.05, 12.0) | st.integers(1, 5).map(float)
boxes = st.tuples(places, places, yaws, sizes, sizes)


def corners(box: Box) -> list[tuple[float, float]]:
    x, y, yaw, length, width = box
    signs = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))
    along, aside = (math.cos(yaw), math.sin(yaw)), (-math.sin(yaw), math.cos(yaw))
    return [
        (x + a * length * along[0] + b * width * aside[0], y + a * length * along[1] + b * width * aside[1])
        for a, b in signs
    ]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((0, 0, 0, 4, 2), (0, 0, QUARTER, 4, 2), 1 / 3),  # crossed: 4 of 8 + 8 − 4
        ((0, 0, 0, 4, 2), (1, 0, 0, 4, 2), 0.6),  # shifted along: 6 of 10
        ((0, 0, 0, 4, 2), (0, 1, 0, 4, 2), 1 / 3),  # shifted aside: 4 of 12
        ((0, 0, 0, 4, 2), (1, 0.5, 0, 1, 1), 1 / 8),  # one inside the other
        ((0, 0, 0, 1, 1), (0, 0, math.pi / 4, 1, 1), 1 / math.sqrt(2)),  # an octagon of area 2 (√2 − 1)
        (
            (0, 0, 0, 2, 2),
            (1, 1, math.pi / 4, math.sqrt(2), math.sqrt(2)),
            1 / 11,
        ),  # a quarter of the tilted one: 0.5 of 4 + 2 − 0.5
        ((1e6, -5e6, 0.3, 4, 2), (1e6, -5e6, 0.3, 4, 2), 1.0),
        ((0, 0, 0.5, 4, 2), (0, 0, 0.5 + math.pi, 4, 2), 1.0),  # turned around
    ],
)
def test_areas_by_hand(first: Box, second: Box, expected: float):
    assert rotated_iou(*map(float, first), *map(float, second)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "second",
    [
        (9.0, 0.0, 0.0, 4.0, 2.0),  # circles around the two are apart
        (0.0, 2.5, 0.0, 4.0, 2.0),  # beside each other: the circles meet, the boxes do not
        (4.0, 0.0, 0.0, 4.0, 2.0),  # end to end: an edge in common has no area
        (4.0, 2.0, 0.0, 4.0, 2.0),  # a corner in common
        (2.6, 1.6, 0.75 * math.pi, 4.0, 0.5),  # no edge of the first, but one of the second parts them
        (0.0, 0.0, 0.0, 0.0, 2.0),
        (0.0, 0.0, 0.0, 4.0, 0.0),
        (0.0, 0.0, 0.0, -4.0, -2.0),
        (0.0, 0.0, 0.0, 1e-200, 1e-200),  # an area too small for a number
        (math.nan, 0.0, 0.0, 4.0, 2.0),
        (0.0, 0.0, math.nan, 4.0, 2.0),
        (0.0, 0.0, 0.0, math.nan, 2.0),
    ],
)
def test_boxes_without_an_area_in_common(second: Box):
    first = (0.0, 0.0, 0.0, 4.0, 2.0)
    assert rotated_iou(*first, *second) == rotated_iou(*second, *first) == 0.0


def test_two_boxes_without_an_area_do_not_overlap():
    assert rotated_iou(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0) == 0.0


@given(boxes)
def test_a_box_overlaps_itself_wholly(box: Box):
    assert rotated_iou(*box, *box) == 1.0


@given(boxes, st.integers(-3, 3))
def test_a_box_turned_by_quarters(box: Box, quarters: int):
    x, y, yaw, length, width = box
    turned = (x, y, yaw + quarters * QUARTER, length, width)
    side = min(length, width)
    expected = 1.0 if quarters % 2 == 0 else side / (2 * max(length, width) - side)
    assert rotated_iou(*box, *turned) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("yaw", "length", "width"), [(0.0, 3.0, 4.9), (3.2, 4.4, 5.8), (-3.3, 3.4, 5.7)])
def test_rounding_does_not_make_more_than_the_whole(yaw: float, length: float, width: float):
    # Turned around, and cut by itself, each of these has an area a little above its own.
    assert rotated_iou(0.0, 0.0, yaw, length, width, 0.0, 0.0, yaw + math.pi, length, width) == 1.0


@given(boxes, boxes)
def test_it_is_what_shapely_finds(first: Box, second: Box):
    a, b = shapely.Polygon(corners(first)), shapely.Polygon(corners(second))
    # On a grid: of boxes that differ by rounding alone Shapely may find no intersection otherwise.
    both = shapely.intersection(a, b, grid_size=1e-10).area
    assert rotated_iou(*first, *second) == pytest.approx(both / (a.area + b.area - both), abs=1e-7)


@given(boxes, boxes)
def test_exchanged_boxes_overlap_as_much_to_the_last_bit(first: Box, second: Box):
    assert rotated_iou(*first, *second) == rotated_iou(*second, *first)


@given(boxes, boxes, yaws, places, places)
def test_where_the_two_are_and_how_they_are_turned_together_does_not_matter(
    first: Box, second: Box, turn: float, east: float, north: float
):
    def moved(box: Box) -> Box:
        x, y, yaw, length, width = box
        c, s = math.cos(turn), math.sin(turn)
        return c * x - s * y + east, s * x + c * y + north, yaw + turn, length, width

    assert rotated_iou(*moved(first), *moved(second)) == pytest.approx(rotated_iou(*first, *second), abs=1e-9)


@given(st.floats(0.5, 10.0), st.floats(0.5, 10.0), st.floats(0.0, 12.0), yaws)
def test_shifted_along_itself_what_is_left_is_the_rest_of_its_length(
    length: float, width: float, shift: float, yaw: float
):
    left = max(length - shift, 0.0)
    shifted = (shift * math.cos(yaw), shift * math.sin(yaw), yaw, length, width)
    expected = left / (2 * length - left)
    assert rotated_iou(0.0, 0.0, yaw, length, width, *shifted) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("value", [-1.0, 0.0, 0.5, 2.0, 2.5, 7.0, 9.0, np.nan, np.inf])
def test_numbers_below_a_value_are_counted(value: float) -> None:
    """As NumPy does, in columns and rows; nothing is below a value where there is nothing."""
    for values in (np.array([0.0, 2.0, 2.0, 2.0, 7.0]), np.array([[0.0, 9.0], [3.0, 9.0]])[:, 0], np.empty(0)):
        assert count_below(values, value) == np.searchsorted(values, value)
