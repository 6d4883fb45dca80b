"""Whether a place is in an area: by Shapely, and at the edges by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from copem_replay.core.geometry import are_in_area, is_in_area, is_in_polygon, polygon_corners

is_in_polygon = njit(is_in_polygon)  # as kernels call it

L_SHAPE = ((0.0, 0.0), (10.0, 0.0), (10.0, 4.0), (4.0, 4.0), (4.0, 10.0), (0.0, 10.0))


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((1, 9), True), ((9, 1), True), ((5, 5), False), ((4, 4), True), ((4, 7), True), ((4.00001, 7), False),
        ((0, 0), True), ((-1e-5, 5), False), ((10, 4), True), ((-3, 4), False), ((12, 4), False), ((2, 10), True),
    ],
)  # fmt: skip
@pytest.mark.parametrize("turned", [1, -1])
def test_an_l_by_hand(place: tuple[float, float], expected: bool, turned: int) -> None:
    assert is_in_polygon(*place, polygon_corners(L_SHAPE[::turned])) is expected


@given(
    st.lists(st.integers(0, 359), min_size=3, max_size=7, unique=True),
    st.lists(st.floats(0.5, 3), min_size=7, max_size=7),
    st.tuples(st.floats(-4, 4), st.floats(-4, 4)),
)
def test_as_shapely_has_it(angles_deg: list[int], radii: list[float], place: tuple[float, float]) -> None:
    # Whole degrees: Shapely divides by zero where two corners are closer than a float can square.
    angles = np.radians(sorted(angles_deg))
    star = tuple((r * math.cos(a), r * math.sin(a)) for a, r in zip(angles, radii, strict=False))
    polygon = shapely.Polygon(star)
    edge_m = shapely.distance(polygon.exterior, shapely.Point(place))
    if not polygon.is_valid or abs(edge_m - 1e-6) < 1e-9:
        return
    assert is_in_polygon(*place, polygon_corners(star)) is bool(polygon.covers(shapely.Point(place)) or edge_m <= 1e-6)


def test_a_range_and_a_polygon() -> None:
    square = polygon_corners(((0, 0), (4, 0), (4, 4), (0, 4)))
    assert is_in_area(3.0, 0.0, 0.0, 0.0, square, 3.0)
    assert not is_in_area(3.1, 0.0, 0.0, 0.0, square, 3.0)
    assert is_in_area(100.0, 0.0, 0.0, 0.0, polygon_corners(None), np.inf)
    x_m = np.array([1.0, 5.0, 3.0])
    assert are_in_area(x_m, x_m, np.zeros(3), np.zeros(3), square, 2.0).tolist() == [True, False, False]
