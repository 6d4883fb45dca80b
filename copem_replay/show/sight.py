"""Lines of sight: which of the shown objects the ego sees, and what hides the others from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from copem_replay.colours import Rgb
from copem_replay.experiment import Experiment
from copem_replay.replay import Replay
from copem_replay.show.out import Out, by_frame, elapsed_ns, f32
from copem_replay.tracks import Float, Int
from copem_replay.units import carrier, observers, poses, unit_ground
from copem_replay.visibility import hidden_by, visible_shares

CLEAR_ABOVE = 0.5
"""Seen when more than this share of it is (chosen)."""
CLEAR: Rgb = (150, 170, 150)
HIDDEN: Rgb = (255, 70, 60)


def sight(out: Out, replay: Replay, experiment: Experiment, shown: Sequence[int]) -> None:
    """From the ego's first unit (the first of all, if it has none) to each shown object, or to what hides it most."""
    import rerun as rr

    if not experiment.modelled or not shown:
        return
    scene, truth = replay.scene, replay.truth
    carriers = {name: carrier(scene, unit) for name, unit in experiment.modelled.items()}
    on_ego = [name for name, on in carriers.items() if on == scene.ego_ix >= 0]
    first = [*on_ego, *carriers][0]
    unit = experiment.modelled[first]
    at = poses(scene, unit, truth, unit_ground(truth, first, unit, []))
    observer, flat = observers([at], np.array([carriers[first]])), experiment.visibility == "flat"
    [share] = visible_shares(truth, replay.placed.static, observer, flat=flat)
    [blocker] = hidden_by(truth, replay.placed.static, observer, flat=flat)
    there = np.isin(truth.row_object_ix, shown) & ~np.isnan(share)  # NaN: the unit is absent, or carried by it
    # What is hidden is hidden by something: −1 comes with a share of 1.
    clear, hidden = there & (share > CLEAR_ABOVE), there & (share <= CLEAR_ABOVE)
    place = f32(at.x_m, at.y_m, at.z_m)
    centre = f32(truth.x_m[0], truth.y_m[0], truth.z_m[0])

    rows, counts = by_frame(truth, clear)
    lines = np.stack([place[truth.frame_ix[rows]], centre[rows]], axis=1)
    out.columns(["world", "sight", "clear"], elapsed_ns(truth), rr.LineStrips3D.columns(strips=lines).partition(counts))
    thin = rr.Radius.ui_points(0.75)
    out.static(["world", "sight", "clear"], rr.LineStrips3D.from_fields(colors=[CLEAR], radii=thin))

    rows, counts = by_frame(truth, hidden)
    bodies = np.concatenate([centre, _obstacle_centres(replay, experiment)])
    hides = np.where(blocker[rows] >= 0, blocker[rows], len(centre) - 2 - blocker[rows])
    lines = np.stack([place[truth.frame_ix[rows]], bodies[hides]], axis=1)
    columns = rr.LineStrips3D.columns(strips=lines, labels=_words(replay, experiment, rows, hides, share[rows]))
    out.columns(["world", "sight", "hidden"], elapsed_ns(truth), columns.partition(counts))
    thick = rr.Radius.ui_points(1.5)
    out.static(
        ["world", "sight", "hidden"], rr.LineStrips3D.from_fields(colors=[HIDDEN], radii=thick, show_labels=True)
    )


def _obstacle_centres(replay: Replay, experiment: Experiment) -> np.ndarray:
    """(K, 3) of the experiment's own obstacles, halfway up."""
    import shapely

    static = replay.placed.static
    if not experiment.obstacles:
        return np.empty((0, 3), dtype=np.float32)
    middle = shapely.centroid([shapely.Polygon(o.polygon_m) for o in experiment.obstacles])
    _, part = np.unique(static.body, return_index=True)
    return f32(shapely.get_x(middle), shapely.get_y(middle), (static.bottom_m + static.top_m)[part] / 2)


def _words(replay: Replay, experiment: Experiment, rows: Int, hides: Int, share: Float) -> pa.Array:
    """(K,) “2 hidden by 3 (share 0.12)”."""
    ids = pa.array(replay.scene.object_ids, pa.string())
    obstacles = pa.array([f"obstacle {k}" for k in range(len(experiment.obstacles))], pa.string())
    bodies = pa.concat_arrays([ids.take(pa.array(replay.truth.row_object_ix)), obstacles])
    hundredths = pa.array([f" (share {k / 100:.2f})" for k in range(101)])
    hidden = ids.take(pa.array(replay.truth.row_object_ix[rows]))
    shares = hundredths.take(pa.array(np.rint(share * 100).astype(np.int64)))
    told = pc.binary_join_element_wise(hidden, bodies.take(pa.array(hides)), " hidden by ")
    return pc.binary_join_element_wise(told, shares, "")
