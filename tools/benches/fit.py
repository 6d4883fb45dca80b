"""Fitting a perception error model to 10⁵ rows: full ladder, five folds, intervals. Seconds of the processor, too.

1,000 straight drives past a unit, 100 lists each, drawn from a table with memory by the replay's own dice.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benches import common
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.extras.fitting.detection import fit_detection
from copem_replay.extras.fitting.replay_check import replay_check, simulate_lists
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.perception.pem.model import Pem

PASSES, LISTS, PERIOD_S = 1000, 100, 0.1
PEM = {
    "couples": [
        {
            "detection": {
                "kind": "table", "range_m": [0, 30, 60], "visible_share": [0, 1],
                "probability": [[0.3, 0.95], [0.2, 0.85], [0.05, 0.6]],
            },
            "error": {"kind": "gaussian", "covariance_m2": [[0.25, 0.0], [0.0, 0.09]]},
        }
    ],
    "memory": {
        "detection": [{"share": 0.6, "correlation_s": 0.8}],
        "position": [{"share": 0.7, "correlation_s": 1.5}],
    },
}  # fmt: skip


def fit() -> Iterator[common.Line]:
    """The full ladder, and the check of a fit by replays."""
    rows, lists = drives()
    fit_detection(rows)
    found, seconds, cpu_s = common.timed(lambda: fit_detection(rows))
    took = {"fit_detection_s": round(seconds, 2), "cpu_s": round(cpu_s, 2)}
    share = found.memory.share.value if found.memory else None
    yield {**took, "rows": len(rows.listed), "rungs": len(found.ladder), "share": share}
    some = rows.take(rows.pass_ix < 100)
    checked = common.timed(lambda: replay_check(Pem.model_validate(PEM), some, lists, runs=500))
    yield {"fit_replay_check_s": round(checked.seconds, 2), "rows": len(some.listed), "runs": 500}


def drives() -> tuple[FitRows, FitLists]:
    """Rows and lists, each object in a log's lists of its own time, with errors as the PEM has them."""
    rng, n = np.random.default_rng(0), PASSES * LISTS
    x = np.linspace(-1, 1, LISTS) * rng.uniform(30, 60, (PASSES, 1))
    y = np.broadcast_to(rng.uniform(2, 20, (PASSES, 1)), x.shape)
    wave = np.sin(rng.uniform(0, 6, (PASSES, 1)) + rng.uniform(0, 6, (PASSES, 1)) * np.arange(LISTS) / LISTS)
    one, none, nothing = np.ones(n), np.full(n, -1), np.full(n, np.nan)
    bearing, share = np.arctan2(y, x).ravel(), np.clip(0.6 + 0.6 * wave, 0, 1).ravel()
    kind = np.zeros(n, dtype=np.int8)
    view = ViewGeometry(np.hypot(x, y).ravel(), bearing, bearing, share, kind, one, one, one, 0 * one, 5 * one)
    number, pass_ix = np.arange(n) % LISTS, np.arange(n) // LISTS
    lists = FitLists(
        np.zeros(LISTS, dtype=int), np.arange(LISTS) * PERIOD_S, *np.zeros((3, LISTS)), np.zeros(LISTS, dtype=int)
    )
    rows = FitRows(
        list=number, log=0 * number, object=pass_ix, pass_ix=pass_ix, captured_s=number * PERIOD_S, view=view,
        state_m=np.stack([x.ravel(), y.ravel()], axis=1), listed=one > 0, along_m=nothing, across_m=nothing,
        east_m=nothing, north_m=nothing, yaw_rad=nothing, speed_mps=nothing, size_m=np.full((3, n), np.nan),
        class_ix=none, existence=nothing, track_id=none, fold=pass_ix % 5,
    )  # fmt: skip
    listed, along_m, across_m = (
        values[0] for values in simulate_lists(Pem.model_validate(PEM), rows, lists, np.zeros(1, dtype=int), 0)
    )
    along_m, across_m = (np.where(listed, error, np.nan) for error in (along_m, across_m))
    cos, sin = np.cos(bearing), np.sin(bearing)
    east_m, north_m = along_m * cos - across_m * sin, along_m * sin + across_m * cos
    found = {"listed": listed, "along_m": along_m, "across_m": across_m, "east_m": east_m, "north_m": north_m}
    return FitRows(**{**vars(rows), **found}), lists
