"""Hold the visible share against lidar: do pedestrians who are seen more return more points?

    python tools/lidar_visibility.py LOG.mcap POINTS.csv

prints one JSON line: `n` pedestrian states within 60 m of the ego, the rank correlation of their lidar returns with
solid angle (height · max(length, width) / distance²) × visible share, and how well the share alone tells states with
returns from those without (area under the ROC curve), for both kinds of visibility. The sensor stands at the centre of
the ego's box, 1.9 m above the ground. POINTS.csv: columns `t` (ns), `id`, `pts` (returns inside the box; −1: unknown).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from copem_replay.core.errors import CopemError
from copem_replay.core.tracks import CLASSES, Float
from copem_replay.io.recording import Recording, read_log
from copem_replay.perception.visibility import NO_STATICS, Flat, Observers, Surface, visible_shares

WITHIN_M = 60.0
SENSOR_HEIGHT_M = 1.9


def main(log: Path, points: Path) -> None:
    recording = read_log(log, name=log.stem)
    states = pedestrians(recording).merge(counted(points), on=["stamp_ns", "id"], how="inner")
    result: dict[str, float | int] = {"n": len(states)}
    for kind in ("surface", "flat"):
        expected = states["solid_angle"] * states[kind]
        result[f"{kind}_spearman"] = round(spearman(expected.to_numpy(), states["pts"].to_numpy()), 4)
        result[f"{kind}_auc"] = round(auc(states[kind].to_numpy(), (states["pts"] > 0).to_numpy()), 4)
    print(json.dumps(result))


def counted(path: Path) -> pd.DataFrame:
    """Lidar returns by stamp and object, states with unknown counts left out."""
    table = pd.read_csv(path).rename(columns={"t": "stamp_ns"})
    table["id"] = table["id"].astype(str)
    return table.loc[table["pts"] >= 0, ["stamp_ns", "id", "pts"]]


def pedestrians(recording: Recording) -> pd.DataFrame:
    """A row per pedestrian state within 60 m of the ego: stamp, id, solid angle, visible shares."""
    truth, scene = recording.truth, recording.scene
    ego = np.flatnonzero(truth.row_object_ix == scene.ego_ix)
    frames, place = truth.frame_ix[ego], np.full((1, len(truth.stamp_ns), 3), np.nan)
    ground_m = truth.z_m[0, ego] - truth.height_m[0, ego] / 2
    place[0, frames] = np.stack([truth.x_m[0, ego], truth.y_m[0, ego], ground_m + SENSOR_HEIGHT_M], axis=-1)
    present = np.isfinite(place[:, :, 0])
    f = truth.frame_ix
    distance_m = np.hypot(truth.x_m[0] - place[0, f, 0], truth.y_m[0] - place[0, f, 1])
    walks = scene.object_class[truth.row_object_ix] == CLASSES.index("pedestrian")
    keep = walks & (distance_m <= WITHIN_M)
    area_m2 = truth.height_m[0] * np.maximum(truth.length_m[0], truth.width_m[0])
    table = pd.DataFrame(
        {
            "stamp_ns": truth.stamp_ns[f],
            "id": np.array(scene.object_ids, dtype=object)[truth.row_object_ix],
            "solid_angle": area_m2 / np.maximum(distance_m, 1e-9) ** 2,
        }
    )
    observers = Observers(place, present, np.array([scene.ego_ix]))
    for model in (Surface(), Flat()):
        table[model.kind] = visible_shares(truth, NO_STATICS, observers, model)[0]
    return table[keep]


def spearman(a: Float, b: Float) -> float:
    """Rank correlation, ties at their mean rank."""
    ranks = [pd.Series(v).rank().to_numpy() for v in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1])


def auc(score: Float, positive: np.ndarray) -> float:
    """Probability that a positive scores higher than a negative, ties half (Mann–Whitney)."""
    ranks = pd.Series(score).rank().to_numpy()
    n = int(positive.sum())
    return float((ranks[positive].sum() - n * (n + 1) / 2) / (n * (len(score) - n)))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python tools/lidar_visibility.py LOG.mcap POINTS.csv")
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    except CopemError as error:
        sys.exit("\n".join(error.problems))
