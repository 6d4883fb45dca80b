"""Results for reports, and what is on a page, read back from its HTML by nothing of ours.

The scene: the ego (1), 4 m long, drives at 10 m/s along x for 5 s. A pedestrian (2), 0.5 m deep, stands in its way at
30 m; another (3) stands 30 m aside. The clock starts at 0.5 s: the ego is at 5 m. Its driver reacts after 0.2 s and
brakes with 8 m/s², which takes 1.25 s and 6.25 m. Known after l seconds, it stops 14.5 − 10 l metres before him.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd

from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.metrics.summary import tally_rows
from copem_replay.results.read import Results, read_results
from copem_replay.results.table_files import write_parquet
from tests.helpers.compare_folders import unseal
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import save_run

TEXT = """\
version: 1
logs: [drive.mcap]
runs: 6
seed: 1
pems:
  sure: [{detection: {kind: constant, probability: 1.0}}]
  half: [{detection: {kind: constant, probability: 0.5}}]
  blind: [{when: {classes: [animal]}, detection: {kind: constant, probability: 1.0}}]
units:
  ego: {on: ego, height_m: 1.8, pem: sure}
  weak: {on: ego, height_m: 1.8, pem: half}
  eye: {on: ego, height_m: 1.8, pem: blind}
configurations:
  GT: {units: truth}
  late: {units: [ego], latency_s: 0.5}
  half: {units: [weak]}
  hit: {units: [ego], latency_s: 1.8}
  never: {units: [eye]}
measure: {onset: {kind: at, time_s: 0.5}}
braking: {driver: {kind: constant_deceleration, a_max_mps2: 8.0, reaction: {kind: constant, delay_s: 0.2}}}
show: null
"""


EVERY = "measure: {onset"
ONE = (EVERY, "measure: {objects: {ids: [2]}, onset")
"""A change: only the pedestrian in the way is measured, whose runs can be resampled."""
ALONE = tuple((f"  {name}:", f"  #{name}:") for name in ("GT", "late", "hit", "never"))
"""A change: only `half` is left."""


def eighteen() -> str:
    """Eighteen configurations beside the ground truth, each 0.1 s later than the one before; two fuse without ids."""
    late = "".join(f"  c{k:02}: {{units: [weak], latency_s: {k / 10}}}\n" for k in range(16))
    late += "  union: {units: [ego, weak], fusion: {kind: union}}\n  gnn: {units: [ego, weak], fusion: {kind: gnn}}\n"
    return changed(ONE, *ALONE[1:], ("  half: {units: [weak]}\n", late))


def drive(path: Path) -> Path:
    frames = [
        (0.1 * k, [Obj(id=1, x=1.0 * k, vx=10.0), pedestrian(2, 30.0), pedestrian(3, 30.0, 30.0)]) for k in range(51)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_recording(path, frames, host=1)


def changed(*changes: tuple[str, str]) -> str:
    """The text with parts replaced, each of which is there."""
    text = TEXT
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text


def replayed(place: Path, text: str = TEXT, *logs: str) -> Path:
    """A results folder beside the recordings it is of."""
    for log in logs or ("drive.mcap",):
        drive(place / log)
    (place / "e.yaml").write_text(text, encoding="utf-8")
    source = read_experiment_file(place / "e.yaml")
    experiment, found = find_problems(source)
    assert experiment is not None, found
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    assert not refused + found
    save_run(place / "results", experiment, recordings)
    return place / "results"


def with_rows(results: Results, table: pd.DataFrame, folder: Path) -> Results:
    """A copy of results with other rows of `detections.parquet`, tallied."""
    shutil.copytree(results.folder, folder)
    write_parquet(table, folder / "detections.parquet")
    write_parquet(tally_rows(table), folder / "tally.parquet")
    return read_results(unseal(folder))


@dataclass
class Cell:
    text: str = ""
    value: str | None = None
    low: str | None = None
    high: str | None = None


@dataclass
class Page(HTMLParser):
    """Elements with their attributes, those of figures by themselves; what there is to read; tables by id, as rows of
    cells by name; ids of the figures.
    """

    html: str
    elements: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    words: str = ""
    head: str = ""
    tables: dict[str, dict[str, dict[str, Cell]]] = field(default_factory=dict)
    rows: dict[str, list[list[str]]] = field(default_factory=dict)
    drawn: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    plots: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()
        self._open: list[str] = []
        self._plot: int | None = None
        self._table, self._row, self._cell = "", "", Cell()
        self.feed(self.html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        inside = self._plot is not None and len(self._open) > self._plot
        (self.drawn if inside else self.elements).append((tag, found))
        if tag not in ("meta", "link", "wbr"):  # that have no end
            self._open.append(tag)
        if tag == "header":
            self._header = len(self.words)
        if tag == "table":
            self._table = found.get("id") or ""
            self.tables[self._table], self.rows[self._table] = {}, []
        if tag == "tr":
            self._row = found.get("data-row") or ""
            self.rows[self._table].append([])
        if tag in ("td", "th"):
            self._cell = Cell("", found.get("data-value"), found.get("data-low"), found.get("data-high"))
            column = found.get("data-column")
            if column is not None:
                self.tables[self._table].setdefault(self._row, {})[column] = self._cell
        if found.get("class") == "plot":
            self.plots.append(found.get("id") or "")
            self._plot = self._open.index("div", len(self._open) - 1)
        if found.get("class") == "story":
            self._plot = len(self._open) - 1

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag, "elements are nested"
        if self._plot == len(self._open):
            self._plot = None
        if tag in ("td", "th"):
            self.rows[self._table][-1].append(self._cell.text)
        if tag in ("p", "li", "h1", "h2", "h3", "summary", "div"):
            self.words += "\n"
        if tag == "header":
            self.head = self.words[self._header :]

    def handle_data(self, data: str) -> None:
        last = next((tag for tag in reversed(self._open) if tag in ("script", "style", "td", "th", "body")), "")
        if last in ("td", "th"):
            self._cell.text += data
        self.words += data if self.cdata_elem is None else ""

    def lines(self) -> list[str]:
        """What the top says, a sentence or paragraph a line."""
        return [re.sub(r"\s+", " ", line).strip() for line in self.head.splitlines() if line.strip()]


def named(configurations: list[str], truths: Sequence[str] = ()) -> Any:
    """What results say of the names of their configurations."""
    facts = {name: SimpleNamespace(truth=name in truths) for name in configurations}
    return SimpleNamespace(experiment=SimpleNamespace(configurations=facts), facts=facts)
