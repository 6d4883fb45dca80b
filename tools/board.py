"""Which fusion? Each over recordings, three kinds of units and two radios, in one table: docs/guide/board.md.

python tools/board.py --page docs/guide/board.md          # all recordings below that are there, into the page
python tools/board.py drive.mcap --fusion my.module:Mine   # yours, and your own fusion beside the others: prints it

Experiments are what `init` drafts, with the units, radios and fusions below. Results folders go into out/board.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from ruamel.yaml import YAML

import copem_replay as cr

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = {
    "logs/crossing.mcap": "simulated, this project",
    "logs/tc016d.mcap": "simulated, this project",
    "../shared/data/av2_3b3570b4.mcap": "recorded, Argoverse 2, CC BY-NC-SA 4.0",
    "../shared/data/nuscenes_scene0061.mcap": "recorded, nuScenes, CC BY-NC-SA 4.0",
    "../shared/data/nuscenes_scene0916.mcap": "recorded, nuScenes, CC BY-NC-SA 4.0",
    "../shared/data/ind_aah1.mcap": "recorded, inD, non-commercial research",
    "../shared/data/drone_swerve.mcap": "recorded, PMSFIT/osc-validation, MPL-2.0",
    "../shared/data/highway_merge.mcap": "simulated, ika-rwth-aachen/omega-prime-visibility, MIT",
    "../shared/data/pedestrian_esmini.mcap": "simulated, ika-rwth-aachen/omega-prime, MPL-2.0",
    "../shared/data/msight_trial14.mcap": "recorded, michigan-traffic-lab/perception_evaluation, MIT",
    "../shared/data/msight_trial15.mcap": "recorded, michigan-traffic-lab/perception_evaluation, MIT",
}
"""Whose they are. None is a second file of a drive that is there already, or has a single road user."""

ALONE, IDEAL, REMEMBERS, TIMED_BY = "alone", "ideal", "ideal:memory", "gnn"
IDEALS: dict[str, tuple[str, dict[str, Any]]] = {
    IDEAL: ("told which entries belong together", {"kind": "ideal"}),
    REMEMBERS: ("told so, and remembers", {"kind": "ideal", "memory": {"kind": "constant_velocity"}}),
}
FUSIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "union": ("all entries side by side", {"kind": "union"}),
    "nms": ("the surest of boxes that overlap", {"kind": "nms"}),
    "nms:centre": ("the surest within 2 m", {"kind": "nms", "by": "centre"}),
    "gnn": ("nearest neighbours, as if errors were independent", {"kind": "gnn"}),
    "gnn:CI": ("the same, covariance intersection", {"kind": "gnn", "combine": "covariance_intersection"}),
    "gnn:fastCI": ("the same, its fast form", {"kind": "gnn", "combine": "fast_covariance_intersection"}),
    "gnn:split": ("the same, half of each error shared", {"kind": "gnn", "combine": "split_covariance_intersection"}),
    "tracker:stale": ("Kalman filters, late lists as if new", {"kind": "tracker", "late": "stale"}),
    "tracker:predict": ("Kalman filters, late lists moved on", {"kind": "tracker", "late": "predict"}),
    "tracker:replay": ("Kalman filters, late lists put in their place", {"kind": "tracker", "late": "replay"}),
}
"""What each does, and its keys; all others are the defaults."""


def make_pem(near: float, far: float, variance: float, lasting: tuple[float, float, float] | None) -> dict[str, Any]:
    """Listed with this share of the visible share at 0 and at 80 m; `variance`: times that of the draft. `lasting`: the
    share of misses that last, how long (s), and ghosts in a list; None: nothing lasts, and there are none.
    """
    seen = {"kind": "table", "range_m": [0, 80], "visible_share": [0, 1], "probability": [[0, near], [0, far]]}
    existence = {"kind": "scores", "real": [8, 2], "ghost": [3, 3], "calibrated": False}
    couples = []
    for when, along in (({"range_m": [0, 80], "azimuth_deg": [-60, 60]}, 0.5), ({"range_m": [0, 30]}, 0.3)):
        spread = [[along * variance, 0.0], [0.0, 0.1 * variance]]
        error = {"kind": "gaussian", "frame": "line_of_sight", "covariance_m2": spread, "speed_sigma_mps": 0.5}
        couples.append({"when": when, "detection": seen, "error": error, "existence": existence})
    if lasting is None:
        return {"couples": couples}
    share, lasts_s, in_list = lasting
    parts = {
        "detection": [{"share": share, "correlation_s": lasts_s}],
        "position": [{"share": 0.5, "correlation_s": 2}],
    }
    where = {"kind": "field", "range_m": [5, 60], "azimuth_deg": [-60, 60]}
    return {"couples": couples, "memory": parts, "ghosts": [{"in_list": in_list, "lasts_s": 1.0, "where": where}]}


UNITS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "good": (make_pem(1.0, 1.0, 0.5, None), {}),
    "usual": (
        make_pem(0.9, 0.6, 1.0, (0.6, 1.0, 0.05)), {"placed": {"position_sigma_m": 0.2, "yaw_sigma_deg": 0.3}}
    ),
    "poor": (make_pem(0.7, 0.3, 4.0, (0.8, 2.0, 0.3)), {"placed": {"position_sigma_m": 0.5, "yaw_sigma_deg": 1.0}}),
}  # fmt: skip
"""Kinds of units: the PEM of all, and what is wrong with those that send."""


def make_radio(mean_s: float, half_at_m: float, **rest: Any) -> dict[str, Any]:
    """Latency of .02 s and more, and lists that half get through at a distance."""
    reception = {"kind": "shadowing", "half_at_m": half_at_m, "exponent": 2.27, "sigma_db": 3, "blocked_db": 9}
    latency = {"kind": "gamma", "min_s": 0.02, "mean_s": mean_s, "shape": 2}
    return {"latency": latency, "reception": reception, **rest}


RADIOS = {
    "good": make_radio(0.06, 150),
    "poor": make_radio(0.3, 60, memory={"reception": [{"share": 1.0, "correlation_s": 0.5}]}),
}
SITUATIONS = [(units, radio) for units in UNITS for radio in RADIOS]
RUNS = 6
FIRST = ("usual", "good")
"""The units and the radio of the table."""

NAN = float("nan")
Fusions = Mapping[str, tuple[str, dict[str, Any]]]


Drafted = tuple[dict[str, Any], dict[str, Any]]
"""An entry of `logs`, and the draft that it is from."""


def draft_log(recording: Path) -> Drafted | None:
    """What the draft says of a recording; None: it has no ego, who could know alone. Raises RecordingError."""
    draft = YAML(typ="safe").load(cr.draft_experiment(recording))
    if not {"ego", "roadside"} <= draft["units"].keys():
        return None
    mast = draft["units"]["roadside"]
    entry = {"file": str(recording), "units": {"roadside": {key: mast[key] for key in ("at", "yaw_deg")}}}
    entry |= {key: draft[key] for key in ("ego",) if key in draft}
    objects = {key: draft["measure"][key] for key in ("objects",) if key in draft["measure"]}
    return entry | ({"measure": objects} if objects else {}), draft


def make_experiment(
    fusions: Fusions, units: str, radio: str, runs: int = 1, logs: Sequence[Drafted] = ()
) -> dict[str, Any]:
    """The experiment of one kind of units and one radio; without `logs`: what all recordings have in common."""
    pem, wrong = UNITS[units]
    both = {"pem": "unit", "rate_hz": 10}
    vehicles = {"classes": ["car", "van", "truck", "bus"], "penetration_rate": 0.2}
    received = {"units": "all", "link": {"ego": "none", "default": "radio"}}
    made = {
        "version": 1, "runs": runs, "seed": 1, "pems": {"unit": pem}, "links": {"radio": RADIOS[radio]},
        "units": {
            "ego": {"on": "ego", **both}, "roadside": {"at": [0, 0], "yaw_deg": 0, "height_m": 6, **both, **wrong},
            "others": {"on": vehicles, "phase_s": 0.03, **both, **wrong},
        },
        "configurations": {ALONE: {"units": ["ego"], "fusion": {"kind": "union"}}}
        | {name: received | {"fusion": keys} for name, (_, keys) in fusions.items()},
        "show": None,
    }  # fmt: skip
    if logs:
        draft = logs[0][1]
        measure = {"onset": draft["measure"]["onset"], "horizon_s": draft["measure"]["horizon_s"]}
        if len(logs) == 1 and "began" in draft["measure"]:
            measure["began"] = draft["measure"]["began"]  # of a single recording few others may count
        made |= {"logs": [entry for entry, _ in logs], "measure": measure, "braking": draft["braking"]}
    return made


# ---------------------------------------------------------------------------------------------------- what was found

KNOWN, HELD, LISTED, BRAKES = "ttd_rmst_s", "position_rmse_held_m", "gospa_held_m", "needless_brake_share"
ALL = "all"
FIGURES = {KNOWN: (IDEAL, 3, 1), HELD: (REMEMBERS, 2, 1), LISTED: (REMEMBERS, 2, 1), BRAKES: (ALONE, 1, 100)}
"""What each metric is held against, its digits, and its scale; less is better."""


@dataclass(frozen=True)
class Found:
    """The results of one kind of units and one radio. `rivals`: the fusions that are told nothing."""

    results: cr.Results
    rivals: tuple[str, ...]

    @cached_property
    def against(self) -> dict[str, pd.DataFrame]:
        """By baseline each configuration against it, by log (`all`: over all of them), configuration and metric."""
        tables = dict[str, pd.DataFrame]()
        for baseline in (ALONE, IDEAL, REMEMBERS):
            rows = cr.compare(self.results, baseline=baseline).table
            if len(self.logs) == 1:  # whose rows are those over all
                rows = pd.concat([rows, rows.assign(log=self.logs[0])])
            tables[baseline] = rows.set_index(["log", "configuration", "metric"]).sort_index()
        return tables

    def row(self, baseline: str, name: str, metric: str, log: str = ALL) -> pd.Series:
        """What `compare` says of a configuration; all of it missing where it has no such figure."""
        rows, key = self.against[baseline], (log, name, metric)
        return rows.loc[key] if key in rows.index else pd.Series(NAN, rows.columns)

    @property
    def logs(self) -> list[str]:
        """The names of the recordings."""
        return [log.name for log in self.results.provenance.logs]

    def figure(self, name: str, metric: str, log: str = ALL) -> float:
        """What a table shows of a fusion: its difference to what the metric is held against."""
        baseline, _, scale = FIGURES[metric]
        return 0.0 if name == baseline else scale * float(self.row(baseline, name, metric, log)["difference"])

    def marks(self, metric: str) -> dict[str, str]:
        """★: every other fusion is shown to be worse; else ☆: the best, and those that are not shown to be worse.

        Behind it, in how many of the recordings it is worse than the best.
        """
        best = min(self.rivals, key=lambda name: self.figure(name, metric))
        rows = cr.compare(self.results, configurations=self.rivals, baseline=best, decide=metric).table
        rows = rows[rows["metric"] == metric].set_index("configuration")
        whole, each = (rows[(rows["log"] == ALL) == of_all] for of_all in (True, False))
        worse = whole.index[(whole["star"] == "*") & (whole["difference"] > 0)]
        left = [name for name in self.rivals if name not in worse]
        if whole.empty or (whole["interval_over"].isna() & (whole["difference"].abs() > 1e-9)).any():
            left = []  # nothing is measured, or there are too few recordings to show anything
        stars = dict.fromkeys(left, " ★" if left == [best] else " ☆")
        behind = (each["difference"] > 1e-9).groupby(level=0, observed=True).agg(["sum", "count"])
        counts = {name: f" {row['sum']}/{row['count']}" for name, row in behind.iterrows()}
        return {name: stars.get(name, "") + counts.get(name, "") for name in self.rivals}


def tell(row: pd.Series, digits: int, scale: int = 1, mark: str = "") -> str:
    """A difference with its mark, and its limits below."""
    low, high = sorted(scale * row[name] for name in ("low", "high"))
    limits = (
        "" if pd.isna([low, high]).any() else f"<br>[{number(low, digits)},\N{NO-BREAK SPACE}{number(high, digits)}]"
    )
    return f"{number(scale * row['difference'], digits)}{mark}{limits}"


def number(value: float, digits: int) -> str:
    """A figure, or a dash for none; no minus before a 0."""
    return "–" if pd.isna(value) else f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def tell_rows(cells: Sequence[Sequence[str]]) -> Iterator[str]:
    """A table of Markdown; the first row is its head."""
    for row in (cells[0], ["---"] * len(cells[0]), *cells[1:]):
        yield f"| {' | '.join(row)} |"


def tell_first(found: Found, fusions: Fusions) -> Iterator[str]:
    """A row for each fusion."""
    marks = {metric: found.marks(metric) for metric in FIGURES}
    head = ["fusion", "known sooner than alone, s", "known later than with the ideal, s"]
    head += ["position error beyond the ideal that remembers, m", "error of the whole list beyond it, m"]
    cells = [[*head, "brakes for nothing beyond alone, %"]]
    for name in fusions:
        row = [f"**{name}**<br>{fusions[name][0]}", tell(found.row(ALONE, name, KNOWN), 2, -1)]
        for metric, (baseline, digits, scale) in FIGURES.items():
            mark = marks[metric].get(name, "")
            row.append("0" if name == baseline else tell(found.row(baseline, name, metric), digits, scale, mark))
        cells.append(row)
    known, brakes = (found.row(IDEAL, ALONE, metric)["value"] for metric in (KNOWN, BRAKES))
    told = (f"known after {number(known, 2)} s", "–", "–", "–", f"{number(100 * brakes, 1)} % of driving")
    cells.append([f"**{ALONE}**<br>the vehicle's own lists", *told])
    yield from tell_rows(cells)


def tell_situations(found: Mapping[tuple[str, str], Found]) -> Iterator[str]:
    """A row for each fusion, a column for each kind of units and each radio."""
    cells = [["fusion", *(f"{units} units, {radio} radio" for units, radio in SITUATIONS)]]
    for name in found[FIRST].rivals:
        cells.append([name])
        for one in found.values():
            told = ((KNOWN, 2, "s"), (HELD, 2, "m"), (BRAKES, 1, "%"))
            cells[-1].append("<br>".join(f"{number(one.figure(name, metric), k)} {unit}" for metric, k, unit in told))
    rows = [one.row(ALONE, IDEAL, KNOWN) for one in found.values()]
    cells.append(["the ideal, sooner than alone", *(f"{number(-row['difference'], 2)} s" for row in rows)])
    cells.append(["alone, known after", *(f"{number(row['baseline_value'], 2)} s" for row in rows)])
    yield from tell_rows(cells)


def tell_recordings(found: Found) -> Iterator[str]:
    """A row for each recording: from the best to the worst fusion."""
    head = ["recording", "objects", "alone, known after, s", "ideal, sooner by, s"]
    cells = [[*head, "known later, s", "position error, m", "brakes for nothing, %"]]
    for log in found.logs:
        of = found.row(ALONE, IDEAL, KNOWN, log)
        row = [log, number(of["n"] / found.results.provenance.runs, 0)]
        row += [number(of["baseline_value"], 2), number(-of["difference"], 2)]
        for metric in (KNOWN, HELD, BRAKES):
            figures = {name: found.figure(name, metric, log) for name in found.rivals}
            ends = [pick(figures, key=lambda name: figures[name]) for pick in (min, max)]
            told = [f"{number(figures[name], FIGURES[metric][1])} {name}" for name in ends]
            row.append("<br>".join(told) if figures[ends[0]] < figures[ends[1]] - 1e-9 else told[0].partition(" ")[0])
        cells.append(row)
    yield from tell_rows(cells)


# ----------------------------------------------------------------------------------------------------- processor time

KEPT: list[cr.Inputs] = []


class Kept(cr.ListFusion):
    """Keeps what it is handed, and lists nothing."""

    def fuse(self, inputs: cr.Inputs) -> cr.ObjectLists:
        """Empty lists."""
        importlib.import_module(Path(__file__).stem).KEPT.append(inputs)  # not this very module where it is a script
        return cr.ObjectLists(np.zeros((len(inputs.lists.start), len(inputs.issue_s) + 1), int), cr.entries_of(0))


def time_fusions(fusions: Fusions, logs: Sequence[Drafted]) -> Iterator[str]:
    """Processor time for each fused list, of one run of the first recording: the best of three."""
    kept = importlib.import_module(Path(__file__).stem).KEPT
    kept.clear()
    told = {name: fusions[name] for name in fusions if name not in IDEALS}
    one = make_experiment({"kept": ("", {"kind": f"{Path(__file__).stem}:Kept"})}, *FIRST, logs=logs[:1])
    cr.fused_tracks(one | {"configurations": {"kept": one["configurations"]["kept"]}}, logs[0][0]["file"])
    made, took_us = cr.load_experiment(make_experiment(told, *FIRST)).configurations, dict[str, float]()
    for name in told:
        spent, fusion = list[float](), made[name].fusion
        assert isinstance(fusion, cr.ListFusion)
        for _ in range(3):
            begun = time.process_time()
            fusion.fuse(kept[0])
            spent.append(time.process_time() - begun)
        took_us[name] = min(spent) / len(kept[0].issue_s) * 1e6
    cells = [["fusion", "µs for each fused list", f"times {TIMED_BY}"]]
    cells += [[name, number(us, 1), number(us / took_us[TIMED_BY], 1)] for name, us in took_us.items()]
    yield from tell_rows(cells)


# ----------------------------------------------------------------------------------------------------------- the board


def digest_settings(runs: int) -> str:
    """Of units, radios, fusions and runs, without recordings and fusions of one's own."""
    settings = [make_experiment({**IDEALS, **FUSIONS}, *one, runs) for one in SITUATIONS]
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def make_board(recordings: Mapping[Path, str], own: Sequence[str], runs: int, out: Path) -> dict[str, str]:
    """Its tables, by name. Raises InputError."""
    mine = {kind: ("your own", {"kind": kind}) for kind in own}
    fusions: Fusions = {**IDEALS, **FUSIONS, **mine}
    cr.load_experiment(make_experiment(fusions, *FIRST))
    drafts = {path: draft_log(path) for path in recordings}
    logs = [drafted for drafted in drafts.values() if drafted is not None]
    if not logs:
        raise cr.InputError([f"{path}: expected a drive with an ego, found none" for path in drafts])
    found = dict[tuple[str, str], Found]()
    for units, radio in SITUATIONS:
        folder = out / f"{units}-units-{radio}-radio"
        shutil.rmtree(folder, ignore_errors=True)
        cr.run(make_experiment(fusions, units, radio, runs, logs)).save(folder)
        found[units, radio] = Found(cr.load_results(folder), (*FUSIONS, *mine))
        print(folder, file=sys.stderr)
    horizon_s = found[FIRST].results.summary["ttd_rmst_horizon_s"].iloc[0]
    told = [f"recordings: {len(logs)}, runs: {runs}, horizon: {horizon_s:g} s, settings: `{digest_settings(runs)}`", ""]
    for log, (entry, _) in zip(found[FIRST].results.provenance.logs, logs, strict=True):
        told.append(f"- `{log.name}` `{log.sha256[:12]}`: {recordings[Path(entry['file'])]}")
    told += [f"- `{path.stem}` is left out: no ego, who could know alone" for path in drafts if drafts[path] is None]
    tables = {
        "first": tell_first(found[FIRST], fusions), "situations": tell_situations(found),
        "recordings": tell_recordings(found[FIRST]), "made": told, "time": time_fusions(fusions, logs),
    }  # fmt: skip
    return {name: "\n".join(lines) for name, lines in tables.items()}


def write_page(page: Path, tables: Mapping[str, str]) -> None:
    """Put each table in its place in a page."""
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        text = re.sub(rf"(?s)(?<=<!-- board: {name} -->\n).*?(?=\n<!-- /board -->)", table, text, count=1)
    page.write_text(text, encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("recordings", nargs="*", type=Path, help="yours [those of the page]")
    parser.add_argument("--fusion", action="append", default=[], help="your own, as my.module:Mine")
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--out", type=Path, default=Path("out/board"), help="where results folders go")
    parser.add_argument("--page", type=Path, help="page to write the tables into [printed]")
    given = parser.parse_args()
    sys.path.append(os.getcwd())
    asked = dict.fromkeys(given.recordings, "yours") or {ROOT / path: whose for path, whose in RECORDINGS.items()}
    there = {path: whose for path, whose in asked.items() if given.recordings or path.exists()}
    for path in asked.keys() - there.keys():
        print(f"not found, and left out: {path.name}", file=sys.stderr)
    try:
        tables = make_board(there, given.fusion, given.runs, given.out)
    except cr.InputError as error:
        print(*error.problems, sep="\n", file=sys.stderr)
        return 2
    if given.page:
        write_page(given.page, tables)
    else:
        print(*tables.values(), sep="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
