"""Where the objects of a list may be: 2σ ellipses of position, paler the older what the list shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Float, Scene
from copem_replay.io.write.drawing import Ellipse, Entity, Pose, Rgba

SIGMAS = 2.0
FRESH_ALPHA, OLDEST_ALPHA, FADES_S = 0.6, 0.15, 1.0
"""How opaque an ellipse is: that of a fresh entry, the least, and after what age (chosen)."""
SMALLEST_M = 0.01
"""Standard deviations below this are not drawn (chosen)."""
_THIN_M = 0.02
Encode = Callable[[Sequence[Entity], int], bytes]
"""Entities, and the instant they hold from, as a message."""


class UncertaintyWriter:
    """Turns the fused lists of one run (values (1, P)) into scenes of ellipses, list by list."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, colour: Rgb, encode: Encode) -> None:
        self._scene, self._fused_tracks, self._encode = scene, fused_tracks, encode
        self._colour = colour[0] / 255, colour[1] / 255, colour[2] / 255
        fused, rows = fused_tracks.fused, len(fused_tracks.fused.frame_ix)
        ee, en, nn = (
            np.zeros(rows) if c is None else np.asarray(c[0], dtype=float)
            for c in (fused.cov_ee_m2, fused.cov_en_m2, fused.cov_nn_m2)
        )
        major, minor, yaw_rad = axes(ee, en, nn)
        on_ground_m = fused.z_m[0] - fused.height_m[0] / 2
        self._drawn = (major >= SMALLEST_M).tolist()  # not the truth, nor what claims none
        columns = major, minor, fused.x_m[0], fused.y_m[0], on_ground_m, yaw_rad
        self._values = list(zip(*(column.tolist() for column in columns), strict=True))
        self._captured_s = fused_tracks.captured_s[0].tolist()

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        available_s = (available_ns - self._scene.t0_ns) * 1e-9
        rows = [row for row in self._fused_tracks.listed(frame) if self._drawn[row]]
        return self._encode([self._entity(row, available_s) for row in rows], available_ns)

    def _entity(self, row: int, available_s: float) -> Entity:
        age_s = max(0.0, available_s - self._captured_s[row])
        told = math.isfinite(age_s)
        faded = min(age_s / FADES_S, 1.0) if told else 1.0
        colour: Rgba = (*self._colour, FRESH_ALPHA + (OLDEST_ALPHA - FRESH_ALPHA) * faded)
        major, minor, *place = self._values[row]
        size = 2 * SIGMAS * major, 2 * SIGMAS * minor, _THIN_M
        name = self._fused_tracks.name_of(self._scene, row)
        return Entity(name, {"age_s": f"{age_s:.3f}"} if told else {}, ellipses=[Ellipse(size, colour, Pose(*place))])


def axes(ee: Float, en: Float, nn: Float) -> tuple[Float, Float, Float]:
    """(P,) standard deviations along the major and minor axes, and how far the major one is turned from east, rad."""
    middle, half = (ee + nn) / 2, np.hypot((ee - nn) / 2, en)
    return np.sqrt(middle + half), np.sqrt(np.maximum(middle - half, 0.0)), np.arctan2(2 * en, ee - nn) / 2
