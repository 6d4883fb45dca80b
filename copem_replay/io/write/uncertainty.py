"""Where the objects of a list may be: 2σ ellipses of position, paler the older what the list shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Float, Int, Scene
from copem_replay.io.write.drawing import Ellipse, Entity, Pose
from copem_replay.io.write.list_blocks import blocks

SIGMAS = 2.0
FRESH_ALPHA, OLDEST_ALPHA, FADES_S = 0.6, 0.15, 1.0
"""How opaque an ellipse is: that of a fresh entry, the least, and after what age (chosen)."""
SMALLEST_M = 0.01
"""Standard deviations below this are not drawn (chosen)."""


@dataclass(frozen=True)
class Ellipses:
    """Upright elliptic cylinders, (N,): names, how old what they show is (empty: not told), places, sizes, opacity."""

    names: list[str]
    ages: list[str]
    x_m: Float
    y_m: Float
    z_m: Float
    yaw_rad: Float
    length_m: Float
    width_m: Float
    alpha: Float
    colour: tuple[float, float, float]
    height_m: float = 0.02

    def entities(self) -> list[Entity]:
        """One by one."""
        numbers = (getattr(self, n).tolist() for n in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "alpha"))
        return [
            Entity(
                name,
                {"age_s": age} if age else {},
                ellipses=[Ellipse((length, width, self.height_m), (*self.colour, alpha), Pose(x, y, z, yaw))],
            )
            for name, age, x, y, z, yaw, length, width, alpha in zip(self.names, self.ages, *numbers, strict=True)
        ]


Encode = Callable[[Ellipses, Int, Int], Iterable[bytes]]
"""Ellipses, the instants (K,) they hold from, and where those of each instant begin (K + 1,), as messages."""


class UncertaintyWriter:
    """Turns the fused lists of one run (values (1, P)) into scenes of ellipses, many lists at once."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, colour: Rgb, encode: Encode) -> None:
        self._t0_ns, self._fused_tracks, self._encode = scene.t0_ns, fused_tracks, encode
        self._colour = colour[0] / 255, colour[1] / 255, colour[2] / 255
        fused, rows = fused_tracks.fused, len(fused_tracks.fused.frame_ix)
        ee, en, nn = (
            np.zeros(rows) if c is None else np.asarray(c[0], dtype=float)
            for c in (fused.cov_ee_m2, fused.cov_en_m2, fused.cov_nn_m2)
        )
        self._major, self._minor, self._yaw_rad = axes(ee, en, nn)
        self._names, self._name = fused_tracks.names_of(scene)

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        rows, bounds = self._fused_tracks.listed_rows
        drawn = self._major[rows] >= SMALLEST_M  # not the truth, nor what claims none
        rows, bounds = rows[drawn], np.concatenate([[0], np.cumsum(drawn)])[bounds]
        for first, last in blocks(bounds):
            time_ns, start = available_ns[first:last], bounds[first : last + 1] - bounds[first]
            available_s = np.repeat((time_ns - self._t0_ns) * 1e-9, np.diff(start))
            yield from self._encode(self._ellipses(rows[bounds[first] : bounds[last]], available_s), time_ns, start)

    def _ellipses(self, rows: Int, available_s: Float) -> Ellipses:
        fused = self._fused_tracks.fused
        age_s = np.fmax(0.0, available_s - self._fused_tracks.captured_s[0, rows])
        return Ellipses(
            names=[self._names[k] for k in self._name[rows].tolist()],
            ages=[f"{age:.3f}" if math.isfinite(age) else "" for age in age_s.tolist()],
            x_m=fused.x_m[0, rows],
            y_m=fused.y_m[0, rows],
            z_m=fused.z_m[0, rows] - fused.height_m[0, rows] / 2,  # on the ground
            yaw_rad=self._yaw_rad[rows],
            length_m=2 * SIGMAS * self._major[rows],
            width_m=2 * SIGMAS * self._minor[rows],
            alpha=FRESH_ALPHA + (OLDEST_ALPHA - FRESH_ALPHA) * np.minimum(age_s / FADES_S, 1.0),
            colour=self._colour,
        )


def axes(ee: Float, en: Float, nn: Float) -> tuple[Float, Float, Float]:
    """(P,) standard deviations along the major and minor axes, and how far the major one is turned from east, rad."""
    middle, half = (ee + nn) / 2, np.hypot((ee - nn) / 2, en)
    return np.sqrt(middle + half), np.sqrt(np.maximum(middle - half, 0.0)), np.arctan2(2 * en, ee - nn) / 2
