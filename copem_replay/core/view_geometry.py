"""What models of a PEM are handed and give: how objects look from a unit, noise, and errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Float, Int

Noise = Callable[[str], Float]
"""`noise(name)` → (S, P) standard normals, addressed by their name: asked for again, they are equal."""


@dataclass(frozen=True)
class ViewGeometry:
    """The view of each observation from its unit. All (P,); nothing here depends on the run.

    `cr.observations` gives these as a table.

    >>> view = cr.ViewGeometry(*np.full((10, 3), 0.5))
    >>> view.take(np.array([0, 2])).visible_share
    array([0.5, 0.5])
    """

    range_m: Float  # horizontal, from the unit's place to the centre of the box
    azimuth_rad: Float  # to the centre of the box, from the unit's heading, (−π, π]
    bearing_rad: Float  # the same from east: the line of sight
    visible_share: Float  # 0 … 1
    class_ix: NDArray[np.int8]  # index into CLASSES
    length_m: Float
    width_m: Float
    height_m: Float
    yaw_rad: Float
    speed_mps: Float

    @classmethod
    def joined(cls, views: Sequence[ViewGeometry]) -> ViewGeometry:
        """The view geometries of several sets of rows, one after the other."""
        return cls(**{f.name: np.concatenate([getattr(view, f.name) for view in views]) for f in fields(cls)})

    def take(self, rows: Int) -> ViewGeometry:
        """The view geometry of some rows."""
        return ViewGeometry(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True)
class Errors:
    """The errors that an error model adds to the true state. Offsets (S, P), variances (P,); None: exact.

    Position in easting and northing. Size is one offset for each of length, width and height: (3, S, P).

    >>> offsets, variances = np.zeros((4, 3)), np.ones(3)
    >>> cr.Errors(offsets, offsets, variances, 0 * variances, variances).yaw_rad is None
    True
    """

    east_m: Float
    north_m: Float
    cov_ee_m2: Float
    cov_en_m2: Float
    cov_nn_m2: Float
    yaw_rad: Float | None = None
    yaw_var_rad2: Float | None = None
    size_m: Float | None = None
    size_var_m2: Float | None = None
    speed_mps: Float | None = None
    speed_var_m2ps2: Float | None = None
