"""What of the units' lists is false or missing, fused list by fused list, as plain data for the detail beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS

if TYPE_CHECKING:
    from copem_replay.core.fused_tracks import FusedTracks

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


def faults_by_list(fused_tracks: FusedTracks) -> list[dict[str, Any]]:
    """For each fused list `ghosts`, entries about no object in the lists that came in with it, and `down`, units.

    A unit is down while the last list that it should have captured was not made. Empty: no unit has such faults.
    """
    faults, heard = fused_tracks.faults, fused_tracks.heard
    if faults is None:
        return []
    issue_s = fused_tracks.fused.common_arrives_s
    told: list[dict[str, Any]] = [{"ghosts": [], "down": []} for _ in issue_s]
    arrives_s = heard.common_arrives_s[heard.frame_ix[faults.ghosts]]
    came = faults.ghosts[np.isfinite(arrives_s) & heard.valid[0, faults.ghosts]]
    # A list belongs to the last instant within a microsecond of its arrival, or the next.
    number = np.searchsorted(issue_s, heard.common_arrives_s[heard.frame_ix[came]] - _TOLERANCE_S)
    for row, k in zip(came.tolist(), number.tolist(), strict=True):
        if k < len(told):
            frame = heard.frame_ix[row]
            told[k]["ghosts"].append(
                {
                    "unit": heard.units[heard.frame_unit_ix[frame]],
                    "captured_ns": int(heard.stamp_ns[frame]),
                    **{name: float(getattr(heard, name)[0, row]) for name in ("x_m", "y_m", "z_m")},
                }
            )
    for unit_ix, unit in enumerate(heard.units):
        mine = np.flatnonzero(heard.frame_unit_ix == unit_ix)
        if not faults.not_made[mine].any():
            continue
        last = np.searchsorted(heard.captured_s[mine], issue_s + _TOLERANCE_S, side="right") - 1
        for k in np.flatnonzero((last >= 0) & faults.not_made[mine[np.maximum(last, 0)]]):
            told[k]["down"].append(unit)
    return told
