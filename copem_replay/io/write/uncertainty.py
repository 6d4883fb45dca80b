"""Where the objects of a list may be: 2σ ellipses of position, paler the older what the list shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Scene
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
        self._scene, self._belief, self._encode = scene, fused_tracks, encode
        self._colour = tuple(c / 255 for c in colour)

    def message(self, frame: int, available_ns: int) -> bytes:
        """List number `frame` as it became available at `available_ns` of the log's clock."""
        available_s = (available_ns - self._scene.t0_ns) * 1e-9
        rows = self._belief.listed(frame)
        found = (self._entity(row, available_s) for row in rows)
        return self._encode([entity for entity in found if entity is not None], available_ns)

    def _entity(self, row: int, available_s: float) -> Entity | None:
        fused, age_s = self._belief.fused, max(0.0, available_s - float(self._belief.captured_s[0, row]))
        says = {"age_s": f"{age_s:.3f}"} if np.isfinite(age_s) else {}
        name = self._belief.name_of(self._scene, row)
        covariance = (fused.cov_ee_m2, fused.cov_en_m2, fused.cov_nn_m2)
        ee, en, nn = (0.0 if c is None else float(c[0, row]) for c in covariance)
        major, minor, yaw_rad = axes(ee, en, nn)
        if major < SMALLEST_M:  # the truth, or none is claimed
            return None
        faded = np.clip(age_s / FADES_S, 0, 1) if np.isfinite(age_s) else 1.0
        colour: Rgba = (*self._colour[:3], float(FRESH_ALPHA + (OLDEST_ALPHA - FRESH_ALPHA) * faded))  # type: ignore[assignment]
        on_ground_m = float(fused.z_m[0, row] - fused.height_m[0, row] / 2)
        pose = Pose(float(fused.x_m[0, row]), float(fused.y_m[0, row]), on_ground_m, yaw_rad)
        return Entity(name, says, ellipses=[Ellipse((2 * SIGMAS * major, 2 * SIGMAS * minor, _THIN_M), colour, pose)])


def axes(ee: float, en: float, nn: float) -> tuple[float, float, float]:
    """Standard deviations along the major and the minor axis, and how far the major one is turned from east, rad."""
    middle, half = (ee + nn) / 2, np.hypot((ee - nn) / 2, en)
    return (
        float(np.sqrt(middle + half)),
        float(np.sqrt(max(middle - half, 0.0))),
        float(np.arctan2(2 * en, ee - nn) / 2),
    )
