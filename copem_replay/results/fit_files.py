"""The folder of a fit: the PEM to paste, the experiment that replays it beside what was recorded, rows and estimates.

Complete under its name, or not there at all, as a results folder (`results/place.py`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import OutputError
from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import commented, dump
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.pipeline.fit.fit import Fit
from copem_replay.pipeline.fit.gather import Gathered
from copem_replay.pipeline.fit.model import experiment_of, pasted
from copem_replay.pipeline.fit.named import as_plain, named_estimates
from copem_replay.results.belongings import MARK
from copem_replay.results.contents import log_entries, said_of_logs, versions, write_parquet
from copem_replay.results.place import EXPERIMENT, Place

PEM, ROWS, ESTIMATES = "pem.yaml", "rows.parquet", "fit.json"
Page = Callable[[Path, Fit], None]
"""Writes a file about a fit."""


def fill_fit(
    place: Place, fit: Fit, experiment: Experiment, recordings: Sequence[Recording], pages: Mapping[str, Page]
) -> None:
    """Write a fit into a place that is taken. `pages`: further files by their names. Raises OutputError.

    `failed` of the place: pages that could not be written.
    """
    files = sorted([PEM, EXPERIMENT, ROWS, ESTIMATES, MARK, *pages])
    replayed = [one for one in recordings if one.scene.log in (fit.held_out or fit.logs)]
    made = versions() | {"format": "fit", "unit": fit.unit, "logs": said_of_logs(recordings), "notes": list(fit.said)}
    try:
        place.will_hold(files)
        new = place.new
        (new / PEM).write_text(pem_text(fit, experiment), encoding="utf-8")
        data = experiment_of(fit, experiment, log_entries(_settings(experiment, replayed), replayed, place.folder))
        (new / EXPERIMENT).write_text(dump(data), encoding="utf-8")
        write_parquet(rows_table(fit, recordings), new / ROWS)
        (new / ESTIMATES).write_text(_json(estimates(fit) | {"provenance": made}), encoding="utf-8")
        for name, page in pages.items():
            with place.may_fail([name]):
                page(new / name, fit)
        files = [name for name in files if name not in place.left_out]
        (new / MARK).write_text(_json(made | {"files": files}), encoding="utf-8")
        place.finish(files)
    except OSError as error:
        raise OutputError(f"{place.folder}: cannot be written: {error.strerror or error}") from error


def _json(data: Mapping[str, Any]) -> str:
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _settings(experiment: Experiment, recordings: Sequence[Recording]) -> list[Any]:
    """The entries of `logs` of some recordings."""
    names = {recording.scene.log for recording in recordings}
    return [entry for entry in experiment.logs if isinstance(entry, str) or entry.name in names]


def pem_text(fit: Fit, experiment: Experiment) -> str:
    """`pem.yaml`: above, what holds for all of it; behind every number, how well it is known."""
    rest = fit.parts.rest
    head = [
        f"Unit {fit.unit}, fitted to {counted(len(fit.logs), 'log')}: {', '.join(fit.logs)}",
        *([f"Held out: {', '.join(fit.held_out)}"] if fit.held_out else []),
        f"{fit.gathered.matched} entries of true objects in {len(fit.gathered.lists.log)} lists, "
        f"{counted(fit.gathered.number_of_passes, 'pass', 'passes')}; truth {fit.truth}",
        f"delay of its lists: `latency_s: {{{fit.unit}: {fit.delay.seconds:.3g}}}` in a configuration: "
        f"{fit.delay.estimate.words()}",
        *(f"{name}: not fitted: {why}" for name, why in rest.untold.items()),
        *fit.gates,
    ]
    return "".join(f"# {' '.join(line.split())}\n" for line in head) + commented(pasted(fit, experiment))


def estimates(fit: Fit) -> dict[str, Any]:
    """`fit.json`: every estimate, and what it is from."""
    return {
        "unit": fit.unit,
        "logs": list(fit.logs),
        "held_out": list(fit.held_out),
        "how": as_plain(fit.how),
        "truth": fit.truth,
        "reach": as_plain(fit.gathered.reach),
        "lists": len(fit.gathered.lists.log),
        "rows": len(fit.gathered.rows.list),
        "matched": fit.gathered.matched,
        "passes": fit.gathered.number_of_passes,
        "beyond_gate_share": fit.gathered.beyond,
        "other_gates": list(fit.gates),
        "estimates": {name: as_plain(one) for name, one in all_estimates(fit)},
        "parts": as_plain(fit.parts),
        "replay_check": as_plain(fit.checks),
        "notes": list(fit.said),
    }


def all_estimates(fit: Fit) -> list[tuple[str, Any]]:
    """Every estimate by its name."""
    first = [("delay_s", fit.delay.estimate), ("rate_hz", fit.rate_hz)]
    return first + [(name.removeprefix("rest."), one) for name, one in named_estimates(fit.parts)]


def rows_table(fit: Fit, recordings: Sequence[Recording]) -> pd.DataFrame:
    """`rows.parquet`: a row per list and true object within reach."""
    pieces = [_rows(fit.gathered, fit.logs, recordings).assign(held_out=False)]
    if fit.held is not None:
        pieces.append(_rows(fit.held, fit.held_out, recordings).assign(held_out=True))
    return pd.concat(pieces, ignore_index=True)


def _rows(gathered: Gathered, logs: Sequence[str], recordings: Sequence[Recording]) -> pd.DataFrame:
    rows, view = gathered.rows, gathered.rows.view
    scenes = {recording.scene.log: recording.scene for recording in recordings}
    names = [scenes[logs[k]].object_ids[o] for k, o in zip(rows.log.tolist(), rows.object.tolist(), strict=True)]
    columns: dict[str, Any] = {
        "log": np.array(logs, dtype=object)[rows.log],
        "list": rows.list,
        "object_id": names,
        "object_class": np.array(CLASSES, dtype=object)[view.class_ix],
        "pass": rows.pass_ix,
        "fold": rows.fold,
        "captured_s": rows.captured_s,
        **{name: getattr(view, name) for name in ("range_m", "azimuth_rad", "bearing_rad", "visible_share")},
        "speed_mps": view.speed_mps,
        "true_x_m": rows.state_m[:, 0],
        "true_y_m": rows.state_m[:, 1],
        "listed": rows.listed,
        **{f"error_{name}": getattr(rows, name) for name in ("along_m", "across_m", "east_m", "north_m", "yaw_rad")},
        "error_speed_mps": rows.speed_mps,
        **{f"error_{name}_m": rows.size_m[k] for k, name in enumerate(("length", "width", "height"))},
        "listed_class": [CLASSES[k] if k >= 0 else None for k in rows.class_ix.tolist()],
        "existence": rows.existence,
        "track_id": pd.array(rows.track_id, dtype="Int64"),
    }
    columns["track_id"][rows.track_id < 0] = pd.NA
    return pd.DataFrame(columns)


def table_lines(fit: Fit) -> list[str]:
    """The estimates as lines of a table, what is not fitted, and which models were compared."""
    parts = fit.parts
    lines = [f"{name}: {one.words()}" for name, one in all_estimates(fit)]
    untold = {**parts.errors.untold, **parts.rest.untold}
    lines += [f"{name}: not fitted: {why}" for name, why in untold.items()]
    ladders = {"detection": parts.detection.ladder, "errors": parts.errors.ladder, "frame": parts.errors.frames}
    lines += [f"{what}, {rung.words()}" for what, rungs in ladders.items() for rung in rungs]
    return lines + ([] if fit.checks is None else list(fit.checks.lines()))
