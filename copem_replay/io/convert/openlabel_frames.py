"""Coordinate systems of OpenLABEL: from the one a cuboid is in to the one that is wanted.

Systems have poses with respect to their parents, and frames have transforms, which win. A matrix of `src` to `dst`,
or of a system with respect to its parent, takes points of the first to the second.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float
from copem_replay.io.convert import rotate
from copem_replay.io.convert.parse import number, shown

Edges = dict[tuple[str, str], Float]
"""(4, 4) matrices by (from, to)."""


def poses(systems: Any, where: str) -> Edges:
    """Poses of all systems that have one. Raises InputError."""
    edges: Edges = {}
    for name, system in _items(systems, where):
        pose = system.get("pose_wrt_parent")
        if pose is not None and system.get("parent"):
            _add(edges, str(name), str(system["parent"]), _matrix(pose, f"{where}: {name}: pose_wrt_parent"))
    return edges


def roots(systems: Any, where: str) -> list[str]:
    """Return the systems without a parent."""
    return [str(name) for name, system in _items(systems, where) if not system.get("parent")]


def transforms(properties: Mapping[str, Any], where: str) -> Edges:
    """Return the transforms of one frame. Raises InputError."""
    edges: Edges = {}
    for name, transform in _items(properties.get("transforms") or {}, where):
        if not {"src", "dst", "transform_src_to_dst"} <= set(transform):
            raise InputError(
                f"{where}: {name}: expected src, dst and transform_src_to_dst, found {', '.join(map(str, transform))}"
            )
        matrix = _matrix(transform["transform_src_to_dst"], f"{where}: {name}")
        _add(edges, str(transform["src"]), str(transform["dst"]), matrix)
    return edges


def path(edges: Edges, source: str, target: str) -> Float | None:
    """(4, 4) matrix from one system to the other by the fewest steps, None where no way leads there."""
    found, queue = {source: np.eye(4)}, [source]
    for here in queue:  # it grows while we go
        if here == target:
            return found[here]
        for (start, end), matrix in edges.items():
            if start == here and end not in found:
                found[end] = matrix @ found[here]
                queue.append(end)
    return None


def _add(edges: Edges, source: str, target: str, matrix: Float) -> None:
    edges[source, target] = matrix
    edges[target, source] = np.linalg.inv(matrix).astype(np.float64)


def _items(systems: Any, where: str) -> list[tuple[str, dict[str, Any]]]:
    if not isinstance(systems, dict) or not all(isinstance(system, dict) for system in systems.values()):
        raise InputError(f"{where}: expected an object of objects, found {shown(systems)}")
    return list(systems.items())


def _matrix(pose: Any, where: str) -> Float:
    """(4, 4) from a matrix, or from a quaternion x y z w and a translation. Raises InputError."""
    pose = pose if isinstance(pose, dict) else {}
    if (flat := pose.get("matrix4x4")) is not None:
        matrix = _numbers(flat, 16, where).reshape(4, 4)
    elif "quaternion" in pose and "translation" in pose:
        x, y, z, w = _numbers(pose["quaternion"], 4, where)[:, None]
        matrix = np.eye(4)
        matrix[:3, :3] = rotate.of_quaternion(w, x, y, z)[0]
        matrix[:3, 3] = _numbers(pose["translation"], 3, where)
    else:
        raise InputError(
            f"{where}: expected matrix4x4, or quaternion and translation, found {', '.join(pose) or 'none'}"
        )
    turned = matrix[:3, :3]
    if not np.isfinite(matrix).all() or not np.allclose(turned @ turned.T, np.eye(3), atol=1e-3):
        raise InputError(f"{where}: expected a rotation and a translation, found another matrix")
    return matrix


def _numbers(values: Any, count: int, where: str) -> Float:
    if not isinstance(values, list) or len(np.ravel(np.array(values, dtype=object))) != count:
        raise InputError(f"{where}: expected {count} numbers, found {shown(values)}")
    return np.array([number(value, where) for value in np.ravel(np.array(values, dtype=object)).tolist()])
