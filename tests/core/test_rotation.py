"""Rotations held against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from copem_replay.core.interpolation import compose_rotations, invert_rotation, rotate_vectors, yaw_of

NUMBER = st.floats(-1, 1)
QUATERNION = (st.tuples(NUMBER, NUMBER, NUMBER, NUMBER).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)).map(
    lambda q: q / np.linalg.norm(q)
)
QUATERNIONS = st.lists(QUATERNION, min_size=1, max_size=4).map(np.array)
PLACE = st.tuples(*[st.floats(-1e4, 1e4)] * 3).map(np.array)


@given(QUATERNIONS, PLACE)
def test_turned(q, place):
    expected = Rotation.from_quat(q).apply(place)
    assert rotate_vectors(q, place) == pytest.approx(expected, abs=1e-9)
    assert rotate_vectors(q, np.tile(place, (len(q), 1))) == pytest.approx(expected, abs=1e-9)
    assert rotate_vectors(q[0], place) == pytest.approx(expected[0], abs=1e-9)


@given(QUATERNION, QUATERNIONS, PLACE)
def test_combined_and_back(p, q, place):
    """As rotations: −q turns as q does."""
    both = compose_rotations(p, q)
    expected = Rotation.from_quat(p) * Rotation.from_quat(q)
    assert rotate_vectors(both, place) == pytest.approx(expected.apply(place), abs=1e-8)
    assert rotate_vectors(invert_rotation(q), place) == pytest.approx(
        Rotation.from_quat(q).inv().apply(place), abs=1e-9
    )


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_yaw(yaw, pitch, roll):
    q = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    assert yaw_of(q[None])[0] == pytest.approx(yaw, abs=1e-9)


def test_a_quarter_to_the_left():
    left = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert rotate_vectors(left, np.array([1.0, 0.0, 2.0])) == pytest.approx([0.0, 1.0, 2.0])
    assert yaw_of(compose_rotations(left, left)[None])[0] == pytest.approx(np.pi)
