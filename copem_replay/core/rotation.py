"""Rotations as unit quaternions (K, 4), or (4,): x, y, z, w.

What little is needed of them, without the import of scipy.spatial, which takes as long as reading a small recording.
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.tracks import Float


def turned(rotation: Float, vector: Float) -> Float:
    """Vectors (K, 3), turned."""
    axis, w = rotation[..., :3], rotation[..., 3:]
    across = np.cross(axis, vector)
    result: Float = vector + 2.0 * (w * across + np.cross(axis, across))
    return result


def combined(outer: Float, inner: Float) -> Float:
    """Turned by `inner`, then by `outer`."""
    a, b, v, w = outer[..., :3], inner[..., :3], outer[..., 3:], inner[..., 3:]
    axis = v * b + w * a + np.cross(a, b)
    return np.concatenate([axis, v * w - (a * b).sum(axis=-1, keepdims=True)], axis=-1)


def back(rotation: Float) -> Float:
    """The other way."""
    result: Float = rotation * np.array([-1.0, -1.0, -1.0, 1.0])
    return result


def yaw_of(rotation: Float) -> Float:
    """(K,) headings."""
    x, y, z, w = rotation.T
    yaw: Float = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw
