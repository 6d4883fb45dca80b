"""Hostile experiments, results folders, recordings to fit, data sets to convert; commands on them. For `fuzz.py`.

The originals are made once. For every seed they are copied, something of them is hit, and commands are called in this
process as `copem-replay` calls them. A command ends with 0, or with 2 and single lines; then all files are as before.
"""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import sys
import traceback
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from fuzzing.mcap_model import Sample, taken_apart
from fuzzing.mutators import BYTES, document_hit, hostile, yaml_hit

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = ("experiment", "results", "fit", "convert")
_SHOWN = "show: {run: 0}"
_MEASURED = "measure: {onset: {kind: in_range, range_m: 60}, horizon_s: 2, accuracy: true, began: [log_start, crossed]}"
_BRAKING = "braking: {driver: {kind: constant_deceleration, a_max_mps2: 8.0, reaction: {kind: constant, delay_s: 0.2}}}"
_CRITERIA = """\
criteria:
  known: {metric: detected_share, at_least: 0.5, each: class}
  soon: {metric: ttd_rmst_s, at_most: 1, population: these_logs}
"""
_FIT = """\
version: 1
logs: [replay.mcap]
units:
  ego: {on: ego, height_m: 1.8, recorded: {topic: copem/PEM/objects}}
configurations:
  recorded: {units: [ego]}
"""
_RICH = (
    """\
version: 1
logs: [{file: drive.mcap, name: one, units: {mast: {yaw_deg: 10}}}]
runs: 2
seed: 3
pems:
  onboard:
    - when: {range_m: [0, 80], azimuth_deg: [-170, 170], classes: [car, vru], visible_share: [0, 1]}
      detection: {kind: table, range_m: [0, 40], visible_share: [0, 1], probability: [[0.0, 0.9], [0.0, 0.5]]}
      error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.5, 0.0], [0.0, 0.5]], mean_m: [0.1, 0.0]}
units:
  ego: {on: ego, height_m: 1.8, pem: onboard, rate_hz: 5, phase_s: 0.02}
  mast: {at: [12.0, -4.5], height_m: 5.0, pem: onboard, outages: {down_share: 0.1, lasts_s: 1}}
links:
  radio: {latency: {kind: constant, s: 0.05}, reception: {kind: constant, probability: 0.9}}
obstacles: [{polygon_m: [[20, 10], [22, 10], [22, 12]], height_m: 3}]
visibility: flat
configurations:
  GT: {units: truth}
  one: {units: [ego], fusion: {kind: tracker}}
  two: {units: all, fusion: {kind: gnn, combine: covariance_intersection}, link: radio}
  late: {units: all, fusion: {kind: union}, latency_s: {ego: 0.0, default: 0.3}}
measure:
  objects: {classes: [car]}
  onset: {kind: in_range, range_m: 60}
  confirm: {hits: 1, of: 2}
  match: {gate_m: 3}
  horizon_s: 2
  by: [class, log*class]
sweep: {latency_s: [0.1, 0.5]}
show: {run: [0, 1]}
"""
    + _CRITERIA
)


@dataclass
class Originals:
    """What is hit: files of a folder, recordings with lists of a unit; and by folder the digests of sound results."""

    folder: Path
    recorded: list[Sample] = field(default_factory=list)
    expected: dict[str, dict[str, bytes]] = field(default_factory=dict)


@dataclass
class Case:
    """A folder with what was hit, what was done to it, and the commands on it."""

    folder: Path
    done: str
    commands: list[list[str]]
    past: Callable[[], object]  # gets past the header, or raises something


def called(arguments: list[str]) -> tuple[int, str]:
    """A command in this process: its exit code, and what it says on stderr."""
    from copem_replay.cli import main as cli

    said = io.StringIO()
    with patch("sys.argv", ["copem-replay", *arguments]), redirect_stderr(said), redirect_stdout(io.StringIO()):
        code = cli._run_to_exit_code()
    return code, said.getvalue()


def _sound(*arguments: str) -> None:
    code, said = called([*arguments])
    if code not in (0, 1):
        raise SystemExit(f"{' '.join(arguments)} ended with {code}: {said}")


# ------------------------------------------------------------------------------- originals


def make_originals(folder: Path, target: str) -> Originals:
    """The originals of a target, in a folder. Every command that will be called is called once, which compiles."""
    sys.path.insert(0, str(ROOT))
    from tests.helpers.experiments import changed, drive

    _with_one_parser()
    made = Originals(folder)
    shutil.rmtree(folder, ignore_errors=True)  # of a process that had to be ended
    folder.mkdir(parents=True)
    os.chdir(folder)
    if target == "convert":
        _write_data_sets(folder)
        return made
    drive(Path("drive.mcap"))
    texts = {"plain": changed("show: null"), "measured": changed(_SHOWN, _MEASURED, _BRAKING, _CRITERIA), "rich": _RICH}
    for name, text in texts.items():
        Path(f"{name}.yaml").write_text(text)
    if target == "fit":
        _sound("run", "measured.yaml", "--out", "run", "--jobs", "1")
        shutil.copy("run/replay.mcap", "replay.mcap")
        Path("fit.yaml").write_text(_FIT)
        _sound("fit", "fit.yaml", "--unit", "ego", "--out", "fit", "--folds", "2", "--simplest")
        made.recorded = [_only(taken_apart(Path("replay.mcap"), 100), {b"truth", b"copem/PEM/objects"})]
        return made
    _without_viewer()
    for name in texts:
        _sound("run", f"{name}.yaml", "--out", name, "--jobs", "1", "--pieces", "pieces")
        made.expected[name] = files_of(Path(name))
        shown = ("layout", "view", "verdict", "history") if name in _SHOWN_ONES else ()
        for command in ("compare", "plot", "report", *shown) if target == "results" else ():
            _sound(command, name)
    return made


def _only(sample: Sample, topics: set[bytes]) -> Sample:
    """A recording without other topics."""
    channels = [channel for channel in sample.channels if channel.topic in topics]
    assert len(channels) == len(topics)
    numbers = {channel.id for channel in channels}
    return replace(sample, channels=channels, messages=[m for m in sample.messages if m.channel in numbers])


def _with_one_parser() -> None:
    """The tree of commands and options is made once, not for every call, of which it would be a third."""
    from copem_replay.cli import main as cli

    if not isinstance(cli.typer, SimpleNamespace):
        once = SimpleNamespace(get_command=cache(cli.typer.main.get_command))
        cli.typer = SimpleNamespace(**{**vars(cli.typer), "main": once})  # type: ignore[assignment]


def _without_viewer() -> None:
    """`view` goes as far as opening a viewer."""
    from copem_replay.viewer import open as viewer

    class Ended:
        """A viewer that was closed at once."""

        def __init__(self, command: list[str]) -> None:
            self.command = command

        def __enter__(self) -> Ended:
            return self

        def __exit__(self, *_: object) -> None:
            return None

        def poll(self) -> int:
            return 0

        wait = poll

    viewer.subprocess = SimpleNamespace(Popen=Ended)  # type: ignore[attr-defined]


def _write_data_sets(folder: Path) -> None:
    import pandas as pd

    from tests.extras import test_convert as tables
    from tests.extras import test_convert_data_sets as sets

    (folder / "csv.csv").write_text(f"{tables.HEADER}\n{tables.CAR}\n0.1,1,car,1,0,0,4,2\n0.1,2,pedestrian,5,5,0,1,1\n")
    vehicles = [f'<vehicle id="e" x="{k}" y="2" angle="90" speed="5" type="mix" z="1"/>' for k in range(4)]
    (folder / "sumo.xml").write_text(tables.fcd(*vehicles))
    turned = tables.state("state", "<exact>3</exact>", "0", "5")
    parts = [
        tables.obstacle("dynamicObstacle", "42", "car", tables.BOX, f"{tables.AT_0}<trajectory>{turned}</trajectory>"),
        tables.obstacle("staticObstacle", "44", "parkedVehicle", tables.BOX, tables.AT_0),
        tables.lanelet("5", "0,0 50,0", "0,-3 20,-4 50,-3", "urban", "crosswalk"),
        '<intersection id="9"><crossing><crossingLanelet ref="5"/></crossing></intersection>',
    ]
    (folder / "commonroad.xml").write_text(tables.scenario(*parts))
    (folder / "openlabel.json").write_text(sets.labels(**sets.kitti()))
    (folder / "openlabel_tumtraf.json").write_text(sets.tumtraf("1.5", 3.0, 0.2))
    argoverse = folder / "argoverse2"
    argoverse.mkdir()
    pd.DataFrame(sets.BOXES).to_feather(argoverse / "annotations.feather")
    pd.DataFrame(sets.POSES).to_feather(argoverse / "city_SE3_egovehicle.feather")


# ------------------------------------------------------------------------------- what is hit


def put_case(made: Originals, seed: str, folder: Path, target: str) -> Case:
    """The case of a seed, in the folder `input` below `folder`."""
    dice = random.Random(f"{seed} {target}")
    place = folder / "input"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    return {"experiment": _experiment, "results": _results, "fit": _fit, "convert": _convert}[target](made, place, dice)


def _experiment(made: Originals, place: Path, dice: random.Random) -> Case:
    name = dice.choice(("plain", "measured", "rich"))
    shutil.copy(made.folder / "drive.mcap", place)
    data = (made.folder / f"{name}.yaml").read_bytes()
    changed = dice.choice(BYTES)(data, dice) if dice.random() < 0.2 else yaml_hit(data, dice)
    (place / "e.yaml").write_bytes(changed)
    commands = [["check", "e.yaml"]]
    if dice.random() < 0.5:
        pieces = ["--pieces", "pieces"] if dice.random() < 0.3 else []
        commands.append(["run", "e.yaml", "--out", "out", "--runs", "2", "--jobs", "1", *pieces])
    return Case(place, f"experiment {name}", commands, lambda: _check_keys(place / "e.yaml"))


def _check_keys(path: Path) -> None:
    """Raise unless a file has keys and values, of this version."""
    from copem_replay.experiment.file import read_experiment_file

    assert read_experiment_file(path).data.get("version") == 1


_HIT = (("provenance.json", 25), ("experiment.yaml", 20), ("made.jsonl", 10))
_SHOWN_ONES = ("measured", "rich")
"""Results with replays, which take most of the time of a run: the third ones have none."""
_REST = 10
"""How often each other file of a results folder is hit, beside those."""


def _results(made: Originals, place: Path, dice: random.Random) -> Case:
    words = {
        "compare": 38, "view": 18, "layout": 13, "run": 13, "verdict": 8, "history": 2, "report": 5, "plot": 3,
        "film": 1,
    }  # fmt: skip
    word = dice.choices([*words], [*words.values()])[0]
    name = dice.choice(_SHOWN_ONES if word in ("view", "layout", "verdict", "history") else ("plain", *_SHOWN_ONES))
    command, done = [word, name], [name]
    shutil.copytree(made.folder / name, place / name)
    for beside in ("drive.mcap", f"{name}.yaml"):
        shutil.copy(made.folder / beside, place)
    if word == "run":
        command = ["run", f"{name}.yaml", "--out", name, "--jobs", "1", "--overwrite", "--pieces", "pieces"]
        shutil.copytree(made.folder / "pieces", place / "pieces")
        for path in dice.sample(pieces := _files(place / "pieces"), dice.choice((0, 1, 3, len(pieces)))):
            done.append(_hit_file(path, place, dice))
    files = _files(place / name)
    weights = [dict(_HIT).get(path.name, _REST if path.parent.name != "figures" else 1) for path in files]
    for path in dict.fromkeys(dice.choices(files, weights, k=dice.choice((1, 1, 2)))):
        done.append(_hit_file(path, place, dice))
    return Case(place, f"results {' '.join(done)}", [command], lambda: _check_mark(place / name))


def _check_mark(folder: Path) -> None:
    from copem_replay.results.provenance import read_provenance

    read_provenance(folder / "provenance.json")


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _hit_file(path: Path, place: Path, dice: random.Random) -> str:
    """Another content, or something else in its place."""
    pick, other = dice.random(), dice.choice(_files(place))
    if pick < 0.04:
        path.unlink()
    elif pick < 0.06:
        path.unlink()
        path.mkdir()
    elif pick < 0.09:
        path.unlink()
        path.symlink_to(dice.choice((str(other), path.name, "../..", "nothing")))
    elif pick < 0.12:
        path.write_bytes(other.read_bytes())
    else:
        path.write_bytes(document_hit(path.name, path.read_bytes(), dice))
    return str(path.relative_to(place))


def _fit(made: Originals, place: Path, dice: random.Random) -> Case:
    (place / "fit.yaml").write_text(_FIT)
    if dice.random() < 0.7:
        data, done = hostile(made.recorded, f"fit {dice.random()}", (40, 100))
        (place / "replay.mcap").write_bytes(data)
    else:
        shutil.copy(made.folder / "replay.mcap", place)
        (place / "fit.yaml").write_bytes(yaml_hit(_FIT.encode(), dice))
        done = "experiment"
    more = dice.choice(([], ["--simplest"], ["--not-monotone"], ["--truth", "partial"], ["--by", "range"]))
    command = ["fit", "fit.yaml", "--unit", "ego", "--out", "out", "--folds", "2", *more]
    return Case(place, f"fit {done}", [command], lambda: _check_fit(place))


def _check_fit(place: Path) -> None:
    from copem_replay.io.open import open_log

    _check_keys(place / "fit.yaml")
    assert any(channel.messages for channel in open_log(place / "replay.mcap").channels)


def _convert(made: Originals, place: Path, dice: random.Random) -> Case:
    source = dice.choice(sorted(made.folder.iterdir()))
    here, kind = place / source.name, source.stem.partition("_")[0]
    if source.is_dir():
        shutil.copytree(source, here)
        hit = dice.choice(_files(here))
        hit.write_bytes(document_hit(hit.name, hit.read_bytes(), dice))
    else:
        here.write_bytes(document_hit(source.name, source.read_bytes(), dice))
    command = ["convert", kind, source.name, "--out", "out.mcap", *(["--rate-hz", "10"] if kind == "openlabel" else [])]
    return Case(place, f"convert {source.name}", [command], lambda: _check_parsed(here))


def _check_parsed(path: Path) -> None:
    """Raise unless a data set is what its name says."""
    import pyarrow.feather

    if path.is_dir():
        for table in _files(path):
            pyarrow.feather.read_table(table)
    elif path.suffix == ".json":
        json.loads(path.read_bytes())
    elif path.suffix == ".xml":
        ET.parse(path)
    elif path.suffix == ".pkl":
        assert path.read_bytes()[:2] == b"\x80\x04"
    else:
        path.read_text()


# ------------------------------------------------------------------------------- what becomes of it


def files_of(folder: Path) -> dict[str, bytes]:
    """Digests of all files of a folder by their names; links by where they lead."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = os.readlink(path).encode(errors="surrogateescape")
        elif path.is_file():
            found[name] = sha256(path.read_bytes()).digest()
    return found


def outcome_of(case: Case, expected: dict[str, dict[str, bytes]]) -> dict[str, Any]:
    """What becomes of a case: `read` or `refused`, or what is wrong with its end."""
    from copem_replay.core.files import find_scratch_names

    os.chdir(case.folder)
    past, said, end = False, [], "read"
    with suppress(Exception):
        case.past()
        past = True
    for command in case.commands:
        before = files_of(Path())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                code, text = called(command)
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                where = traceback.extract_tb(error.__traceback__)[-1]
                return _defect(f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}", command)
        said += (lines := text.splitlines())
        after = files_of(Path())
        if (
            code not in (0, 2) and not (code == 1 and command[0] in ("fit", "verdict", "run"))
        ) or "internal error" in text:
            return _defect(f"exit code {code}: {' | '.join(lines[-6:])[-400:]}", command)
        if any(not all(c.isprintable() for c in line) for line in lines) or (code == 2 and not lines):
            return _defect(f"not printable lines: {text[-200:]!r}", command)
        if code == 2 and (other := _differing(before, after)):
            return _defect(f"refused, and {other} is not as before", command)
        if any(find_scratch_names(folder) for folder in (Path(), *(p for p in Path().rglob("*") if p.is_dir()))):
            return _defect("left a temporary name behind", command)
        if code in (0, 1) and "--overwrite" in command:
            sound = expected[command[3]]
            made = files_of(Path(command[3]))
            same = [name for name in sound if not name.endswith((".rrd", "made.jsonl"))]
            if other := [name for name in same if made.get(name) != sound[name]]:
                return _defect(f"results differ from sound ones: {other[0]}", command)
        end = "refused" if code == 2 else end
    return {"outcome": end, "said": said, "past": past}


def _differing(before: dict[str, bytes], after: dict[str, bytes]) -> str:
    """A file that differs, those of pieces left out, which are kept whatever becomes of a run; empty: none."""
    names = (name for name in before | after if not name.startswith("pieces/"))
    return next((name for name in names if before.get(name) != after.get(name)), "")


def _defect(what: str, command: list[str]) -> dict[str, Any]:
    return {"outcome": "defect", "what": what, "command": " ".join(command)}
