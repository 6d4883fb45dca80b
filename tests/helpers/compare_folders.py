"""Results folders written by hand: a few rows of every table, so that differences can be computed in the head."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.columns import TABLES
from copem_replay.pipeline.expansion import find_facts
from tests.oracles import intervals

Row = dict[str, Any]


def limits_of(
    names: Sequence[str], figure: Callable[[list[str]], float], weights: Sequence[float] | None = None
) -> tuple[float, float]:
    """Limits of a figure of clusters, from the figure without each of them; None: all weigh the same."""
    without = [figure([name for name in names if name != out]) for out in names]
    return intervals.figure(figure(list(names)), without, weights or [1.0] * len(names))


INSTANTS = [0.0, 1.0, 2.0, 3.0]
"""Of the frames of the truth, and of the fused lists of every configuration, unless told otherwise."""
MAX_AGE_S = 1.0

_TYPES = {
    "text": pa.string(), "whole numbers": pa.int64(), "numbers": pa.float64(), "true or false": pa.bool_(),
    "lists of numbers": pa.list_(pa.float64()), "lists of whole numbers": pa.list_(pa.int64()),
}  # fmt: skip

MEASURE = {
    "objects": {"classes": None, "ids": None},
    "onset": {"kind": "in_range", "range_m": 50.0},
    "began": ["crossed", "appeared"],
    "count_earlier": False,
    "confirm": {"hits": 1, "of": 1},
    "match": {"gate_m": 3.0},
    "distance_to": "ego",
    "horizon_s": 10.0,
    "conflict": None,
    "exact": False,
    "accuracy": True,
    "gospa": {"cutoff_m": None, "power": 2.0},
    "horizon_used_s": 10.0,
}
UNREMARKABLE = dict.fromkeys(
    ("truth", "recorded", "by_truth_id", "fixed", "fixed_verdicts", "needs_visibility"), False
) | {"ideal": None, "ideal_of": None, "remembering": None}
"""A configuration of which nothing is known but its rows."""
LINKS = {"radio": {"latency": 0.1}}
BRAKING = {"driver": {"kind": "constant_deceleration", "a_max_mps2": 8.0}, "margin_m": 0.5, "brakes_for": "object"}


def row(configuration: str, detection_s: float | None, distance_m: float | None = None, **more: Any) -> Row:
    """Object 7 of log `a` in run 0: from 0 s on, for 10 s, then it left. `more`: other columns, of any table."""
    given = {
        "log": "a",
        "configuration": configuration,
        "run": 0,
        "object_id": "7",
        "episode": 0,
        "onset_s": 0.0,
        "began": "crossed",
        "detected": detection_s is not None,
        "detection_s": detection_s,
        "distance_at_detection_m": distance_m,
        "ended_s": 10.0,
        "ended_by": "object_left",
    }
    return given | more


def seen(configuration: str, error_m: Sequence[float | None], gospa_m2: Sequence[float | None], **more: Any) -> Row:
    """The same row with what is held of the object, at all frames from `first_frame` on. `age_s`: of its entries."""
    age_s = more.pop("age_s", 0.25)
    ages = [None if error is None else age_s for error in error_m]
    held = {"error_held_m": list(error_m), "age_held_s": ages, "gospa_held_m2": list(gospa_m2)}
    return row(configuration, 0.0, 20.0) | held | {"first_frame": 0, "ghosts": 0} | more


def held_lists(available_s: Sequence[float]) -> list[int | None]:
    """The list that is held at each of INSTANTS, none where the newest is older than MAX_AGE_S."""
    held: list[int | None] = []
    for time_s in INSTANTS:
        by_then = [k for k, since_s in enumerate(available_s) if since_s <= time_s + 1e-6]
        held.append(by_then[-1] if by_then and time_s - available_s[by_then[-1]] <= MAX_AGE_S + 1e-6 else None)
    return held


def ghosts(configuration: str, count: int, **more: Any) -> Row:
    """Lists of log `a` in run 0, over a minute, `count` ghosts in them."""
    given = {"log": "a", "configuration": configuration, "run": 0, "lists": 4, "minutes": 1.0, "ghosts": count}
    return given | {"duplicates": 0, "without_truth": 0, "existence": [0.0], "ghosts_at": [count]} | more


def step(configuration: str, existence: float, detection_s: float, **more: Any) -> Row:
    """Object 7 of log `a` in run 0 is detected at `detection_s` with thresholds up to `existence`."""
    given = {"log": "a", "configuration": configuration, "run": 0, "object_id": "7", "episode": 0}
    return given | {"existence": existence, "detection_s": detection_s} | more


def write_folder(
    path: Path,
    rows: Sequence[Row],
    *,
    lists: Sequence[Row] = (),
    steps: Sequence[Row] | None = None,
    available_s: dict[str, Sequence[float]] | None = None,
    logs: dict[str, str] | None = None,
    ego: str | None = None,
    measure: dict[str, Any] | None = None,
    experiment: dict[str, Any] | None = None,
    facts: dict[str, dict[str, Any]] | None = None,
    **provenance: Any,
) -> Path:
    """A results folder. `logs`: names and contents; `available_s`: by configuration, where not INSTANTS.

    `experiment`: further keys of experiment.yaml; where it has configurations, what they are is found by them. `facts`:
    by configuration what differs from `UNREMARKABLE`.
    """
    path.mkdir(parents=True)
    names = list(dict.fromkeys(r["log"] for r in rows))
    logs = logs or {name: f"content of {name}" for name in names}
    said = {
        "copem_replay": "0",
        "format": 6,
        "seed": 1,
        "runs": max(r["run"] for r in rows) + 1,
        "logs": [{"log": name, "topic": "ground_truth", "sha256": of, "truth": of} for name, of in logs.items()],
        "visibility": "surface",
        "max_gap_s": 0.5,
        "measure": MEASURE | (measure or {}),
        "braking": None,
        "configurations": {r["configuration"]: UNREMARKABLE for r in rows},
    }
    if "configurations" in (experiment or {}):
        plan = Experiment.model_validate({"version": 1, "logs": ["a.mcap"], "links": LINKS} | (experiment or {}))
        said["configurations"] = {name: asdict(of) for name, of in find_facts(plan).items()}
    in_sight = {"needs_visibility": said["measure"]["onset"]["kind"].startswith("line_of_sight")}
    said["configurations"] = {
        name: of | in_sight | (facts or {}).get(name, {}) for name, of in said["configurations"].items()
    }
    said |= provenance
    (path / "provenance.json").write_text(json.dumps(said))
    more = "".join(f"{key}: {json.dumps(value)}\n" for key, value in (experiment or {}).items())
    (path / "experiment.yaml").write_text(f"version: 1\nego: {'null' if ego is None else ego}\n{more}")
    _write(path / "detections.parquet", rows, *["braking"] * bool(said["braking"]))
    if any("error_held_m" in r for r in rows):
        _write(path / "accuracy.parquet", rows)
        of = [(log, name) for log in names for name in dict.fromkeys(r["configuration"] for r in rows)]
        issued_s = [list((available_s or {}).get(name, INSTANTS)) for _, name in of]
        instants = [
            {"log": log, "configuration": name, "available_s": a, "frame_s": INSTANTS, "held_list": held_lists(a)}
            for (log, name), a in zip(of, issued_s, strict=True)
        ]
        _write(path / "instants.parquet", instants)
    if lists:
        _write(path / "lists.parquet", lists)
    if steps is not None:
        _write(path / "thresholds.parquet", steps)
    return path


def _write(path: Path, rows: Sequence[Row], *asked: str) -> None:
    """The columns that comparisons read."""
    kinds = TABLES[path.name].kinds(*asked, compared=True)
    parquet.write_table(pa.table({n: pa.array([r.get(n) for r in rows], _TYPES[k]) for n, k in kinds.items()}), path)


def unseal(folder: Path) -> Path:
    """Results as older versions wrote them, without seals: tests of a reader may change their files."""
    file = folder / "provenance.json"
    said = json.loads(file.read_text())
    said.pop("sha256", None)
    file.write_text(json.dumps(said))
    return folder


def flip(path: Path, bit: int) -> None:
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def places(path: Path, count: int) -> list[int]:
    """Bits of a file from its first to its last, and the same number on every run."""
    last = 8 * path.stat().st_size - 1
    return sorted({round(last * k / (count - 1)) for k in range(count)})
