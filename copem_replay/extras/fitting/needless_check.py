"""Braking for nothing: whether a fitted model makes the driver brake as the recorded lists do, on drives held out.

Both are replayed with all entries as they come (`union`), and judged as everywhere (`metrics/braking/needless.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from copem_replay.experiment.schema import Experiment
from copem_replay.extras.fitting.fit import Fit, build_experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.driver import R157
from copem_replay.metrics.braking.driving import RATE, SHARE
from copem_replay.metrics.config import GHOST_ENTRY
from copem_replay.results.provenance import log_entries

_RUNS = 20


@dataclass(frozen=True)
class NeedlessCheck:
    """Braking for nothing of the recorded and of the fitted unit (2,): share of the driving time, times per hour, share
    of these for ghosts (None: never braked). `why`: the reason why nothing can be told, else empty.
    """

    why: str = ""
    driving_s: float = 0.0
    share: tuple[float, ...] = ()
    per_h: tuple[float, ...] = ()
    ghosts: tuple[float | None, ...] = ()

    def line(self) -> str:
        """A line for the table of the fit: needless braking as recorded and as fitted, or why it is not known."""
        if self.why:
            return f"braking for nothing on logs held out: not known: {self.why}"
        parts = [
            f"{name} {100 * share:.2g} % of the time, {per_h:.3g} an hour"
            + ("" if ghosts is None else f", {100 * ghosts:.0f} % for ghosts")
            for name, share, per_h, ghosts in zip(
                ("recorded", "fitted"), self.share, self.per_h, self.ghosts, strict=True
            )
        ]
        return f"braking for nothing on logs held out, {self.driving_s:.3g} s of driving: {'; '.join(parts)}"


def check_needless(fit: Fit, experiment: Experiment, recordings: Sequence[Recording]) -> NeedlessCheck | None:
    """The check on the logs that are held out; None: there are none."""
    from copem_replay.api.run import run

    held_logs = [recording for recording in recordings if recording.scene.log in fit.held_out]
    if not held_logs:
        return None
    if any(recording.scene.ego_ix < 0 or not recording.scene.ego_sized for recording in held_logs):
        return NeedlessCheck("no ego, or its size is not known")
    if not all(recording.lists[fit.unit].velocity_said for recording in held_logs):
        return NeedlessCheck("its lists state no velocity")
    settings = [entry for entry in experiment.logs if isinstance(entry, str) or entry.name in fit.held_out]
    data = build_experiment(fit, experiment, log_entries(settings, held_logs, Path()))
    configurations = {name: of | {"fusion": {"kind": "union"}} for name, of in data["configurations"].items()}
    braking: Any = {"driver": R157} if experiment.braking is None else data["braking"] | {"needless": {}}
    measure = data["measure"] | {"accuracy": True, "exact": False, "metrics": [], "by": []}
    overrides = {"runs": _RUNS, "show": None, "criteria": {}, "braking": braking, "measure": measure}
    results = run({**data, **overrides, "configurations": configurations})
    summary = results.summary.set_index("configuration").loc[["recorded", "fitted"]]
    if not summary["driving_h"].max() > 0:
        return NeedlessCheck("the ego does not drive")
    events = results.frame("needless.parquet").groupby("configuration")["cause"]
    ghosts = [
        events.get_group(name).eq(GHOST_ENTRY).mean() if name in events.groups else None for name in summary.index
    ]
    driving_s = 3600 * float(summary["driving_h"].max())
    return NeedlessCheck("", driving_s, tuple(summary[SHARE]), tuple(summary[RATE]), tuple(ghosts))
