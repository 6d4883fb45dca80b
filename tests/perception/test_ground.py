"""The ground under places and obstacles: the state nearest to them, of all."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.perception.sensor_poses import ground_at

SQUARE = [[-4.0, -3.0], [6.0, -3.0], [6.0, 5.0], [-4.0, 5.0]]
BENT = [[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [28.0, 30.0], [28.0, 2.0], [0.0, 2.0]]


def states(places: np.ndarray) -> Any:
    """Objects of 2 m at these places, each on a ground of its own."""
    n = len(places)
    return SimpleNamespace(
        frame_ix=np.zeros(n, dtype=np.int64), x_m=places[None, :, 0], y_m=places[None, :, 1],
        z_m=np.arange(n, dtype=float)[None] + 1.0, height_m=np.full((1, n), 2.0),
    )  # fmt: skip


@given(
    st.lists(st.tuples(st.integers(-90, 90), st.integers(-90, 90)), min_size=1, max_size=60),
    st.sampled_from([[[0.0, 0.0]], [[3.5, -7.0]], SQUARE, BENT]),
    st.sampled_from([0.0, 0.1, 5e6]),
)
def test_it_is_that_of_the_nearest_of_all_the_first_of_equals(
    places: list[tuple[int, int]], corners: list[list[float]], shift_m: float
) -> None:
    at, given_ = np.array(places, dtype=float) + shift_m, np.array(corners) + shift_m
    place = shapely.Point(given_[0]) if len(given_) == 1 else shapely.Polygon(given_)
    distance = [place.distance(shapely.Point(one)) for one in at]
    expected = float(np.argmin(distance)) if min(distance) <= 50.0 else None
    assert ground_at(states(at), given_) == expected


def test_no_states_no_ground() -> None:
    assert ground_at(states(np.empty((0, 2))), np.array([[0.0, 0.0]])) is None


@pytest.mark.parametrize(("x_m", "expected"), [(50.0, 0.0), (50.001, None)])
def test_within_fifty_metres(x_m: float, expected: float | None) -> None:
    assert ground_at(states(np.array([[x_m, 0.0]])), np.array([[0.0, 0.0]])) == expected
