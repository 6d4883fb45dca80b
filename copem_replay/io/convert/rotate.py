"""Rotations as matrices, (…, 3, 3), and the yaw of one."""

from __future__ import annotations

import math

import numpy as np

from copem_replay.core.tracks import Float


def of_quaternion(w: Float, x: Float, y: Float, z: Float) -> Float:
    """Rotation matrices (N, 3, 3) of quaternions, (N,) each, of any length but 0 (then NaN)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = np.array([w, x, y, z], dtype=np.float64) / np.sqrt(w * w + x * x + y * y + z * z)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: Float = np.moveaxis(np.array(rows), -1, 0)
    return matrices


def of_euler(roll: float, pitch: float, yaw: float) -> Float:
    """Rotation matrix (3, 3): first roll about x, then pitch about y, then yaw about z, all axes fixed."""
    half = np.array([roll, pitch, yaw]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    matrix: Float = of_quaternion(*(np.array([v]) for v in (w, x, y, z)))[0]
    return matrix


def wrapped(yaw_rad: float) -> float:
    """Return the same direction in [−π, π]."""
    return math.remainder(yaw_rad, math.tau)
