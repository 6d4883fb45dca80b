"""A results folder as a comparison reads it: its provenance, and its tables as far as there are some."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import TRUTH
from copem_replay.core.yaml import NotYamlError, read
from copem_replay.metrics.config import Measure
from copem_replay.metrics.fixed import Fixed, fixed_in
from copem_replay.results.belongings import check_still

if TYPE_CHECKING:
    import pyarrow as pa

_AGAIN = "run the experiment again with --overwrite"
_KEYS = {"log": "text", "configuration": "text", "run": "whole numbers"}
_OBJECT = _KEYS | {"object_id": "text"}
_DETECTIONS = _OBJECT | {
    "onset_s": "numbers",
    "detected": "true or false",
    "detection_s": "numbers",
    "distance_at_detection_m": "numbers",
    "ended_s": "numbers",
    "ended_by": "text",
}
_BRAKING = {"conflict": "true or false", "braking_pass": "true or false"}
OPTIONAL = {
    "accuracy.parquet": _OBJECT
    | {
        "first_list": "whole numbers",
        "error_m": "lists of numbers",
        "gospa_m2": "lists of numbers",
        "ghosts": "whole numbers",
    },
    "instants.parquet": {"log": "text", "configuration": "text", "available_s": "lists of numbers"},
    "lists.parquet": _KEYS
    | {
        "minutes": "numbers",
        "ghosts": "whole numbers",
        "existence": "lists of numbers",
        "ghosts_at": "lists of whole numbers",
    },
    "thresholds.parquet": _OBJECT | {"existence": "numbers", "detection_s": "numbers"},
}
"""Files of a results folder that need not be there, and their columns that are read."""


@dataclass(frozen=True)
class LogFile:
    """A recording that was replayed: its name in the tables, the topic of its truth, its content."""

    name: str
    topic: str | None
    sha256: str


@dataclass(frozen=True, eq=False)
class Folder:
    """A results folder. `measure` has every default filled in; `tables`: by file name, those that are there."""

    path: Path
    seed: int
    runs: int
    logs: tuple[LogFile, ...]
    visibility: str | None
    max_gap_s: float | None
    window_s: object
    measure: dict[str, Any]
    braking: dict[str, Any] | None
    ego: object
    fixed: Fixed  # what is the same in every run
    by_truth_id: frozenset[str]  # configurations that detect by truth id: the truth, and ideal fusion
    truth: frozenset[str]  # configurations that are the truth
    horizon_used_s: float | None
    tables: dict[str, pa.Table]

    @property
    def name(self) -> str:
        """What the folder is called, wherever one stands."""
        return self.path.resolve().name

    @property
    def detections(self) -> pa.Table:
        """The rows of `detections.parquet`."""
        return self.tables["detections.parquet"]

    def configurations(self) -> list[str]:
        """Names of the configurations that have rows, in their order."""
        names: list[str] = self.detections["configuration"].unique().to_pylist()
        return names


def read_folder(path: Path) -> Folder:
    """Read a results folder. Raises InputError, one line: no such folder, no results, or damaged ones."""
    if not path.is_dir():
        found = "a file" if path.exists() else "no such folder"
        raise InputError(f"{path}: expected a results folder, found {found}; `copem-replay run` writes one")
    for name in ("provenance.json", "experiment.yaml", "detections.parquet"):
        if not (path / name).is_file():
            raise InputError(f"{path}: expected a results folder, found no {name} in it; `copem-replay run` writes one")
    seen = os.stat(path)
    fields = _provenance(path / "provenance.json")
    columns = _DETECTIONS | (_BRAKING if fields["braking"] is not None else {})
    if _rowless(path / "detections.parquet"):
        raise InputError(f"{path}: nobody was measured, so nothing can be compared: no measured object has an onset")
    tables = {"detections.parquet": _table(path / "detections.parquet", columns)}
    tables |= {name: _table(path / name, of) for name, of in OPTIONAL.items() if (path / name).is_file()}
    experiment = _experiment(path / "experiment.yaml")
    check_still(path, seen)
    always = bool(fields["measure"]["match"].get("always"))
    said = _configurations(experiment)
    by_id = frozenset() if always else frozenset(name for name, one in said.items() if _knows_ids(one))
    truth = frozenset(name for name, one in said.items() if one.get("units") == TRUTH)
    return Folder(
        path=path, ego=experiment.get("ego"), by_truth_id=by_id, truth=truth, fixed=fixed_in(experiment),
        tables=tables, **fields,
    )  # fmt: skip


def _rowless(path: Path) -> bool:
    """Whether a table is sound and has no row: then its columns have no types either."""
    from pyarrow import parquet

    try:
        return bool(parquet.read_metadata(path).num_rows == 0)
    except (OSError, ValueError):  # it is said by who reads it
        return False


def _provenance(path: Path) -> dict[str, Any]:
    """What `provenance.json` says, by the fields of Folder. Raises InputError."""
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
        logs = tuple(LogFile(str(log["log"]), log.get("topic"), str(log["sha256"])) for log in data["logs"])
        measure, braking, gap_s = dict(data["measure"]), data.get("braking"), data.get("max_gap_s")
        used_s = measure.pop("horizon_used_s", None)
        return {
            "seed": int(data["seed"]),
            "runs": int(data["runs"]),
            "logs": logs,
            "visibility": data.get("visibility"),
            "max_gap_s": None if gap_s is None else float(gap_s),
            "window_s": data.get("window_s"),
            # A key that an older version did not have stood for its default.
            "measure": Measure().model_dump(mode="json", by_alias=True) | measure,
            "braking": None if braking is None else dict(braking),
            "horizon_used_s": None if used_s is None else float(used_s),
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected the provenance of results, found damage: {why}; {_AGAIN}") from None


def _configurations(experiment: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What is said of each configuration."""
    said = experiment.get("configurations")
    return {str(name): one for name, one in said.items() if isinstance(one, dict)} if isinstance(said, dict) else {}


def _knows_ids(configuration: dict[str, Any]) -> bool:
    """Whether a configuration needs no match with the truth to know an object."""
    fusion = configuration.get("fusion")
    return fusion is None or bool(fusion.get("kind", "ideal") == "ideal")


def _experiment(path: Path) -> dict[str, Any]:
    """The experiment as plain data. Raises InputError."""
    try:
        data, _, _ = read(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict):
            raise TypeError("no keys and values")
        return data
    except (OSError, ValueError, TypeError, NotYamlError) as error:
        why = " ".join(str(error).split())
        raise InputError(f"{path}: expected the experiment of the results, found damage: {why}; {_AGAIN}") from None


def _table(path: Path, columns: dict[str, str]) -> pa.Table:
    """These columns of a table, text as `string`. Raises InputError where one is missing or of another kind."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        there = parquet.read_schema(path).names
        if missing := [name for name in columns if name not in there]:
            raise InputError(f"{path}: expected the column {missing[0]}, found none; {_AGAIN}")
        table = parquet.read_table(path, columns=list(columns))
    except (OSError, ValueError) as error:  # what Arrow raises derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{path}: expected a table that can be read, found damage: {why}; {_AGAIN}") from None
    for k, (name, kind) in enumerate(columns.items()):
        column = table[name]
        if kind == "text" and pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        if not _is(kind, column.type):
            raise InputError(f"{path}: column {name}: expected {kind}, found {column.type}; {_AGAIN}")
        if kind == "text":
            if column.null_count:
                raise InputError(f"{path}: column {name}: expected text in every row, found none in some; {_AGAIN}")
            column = column.cast(pa.string())
        table = table.set_column(k, name, column)
    return table


def _is(kind: str, what: pa.DataType) -> bool:
    import pyarrow as pa

    types = pa.types
    if kind.startswith("lists of "):
        listed = types.is_list(what) or types.is_large_list(what)
        return bool(listed and _is(kind.removeprefix("lists of "), what.value_type))
    if types.is_null(what):  # nothing but nulls
        return kind != "text"
    return bool(
        {
            "text": types.is_string(what) or types.is_large_string(what) or types.is_dictionary(what),
            "whole numbers": types.is_integer(what),
            "numbers": types.is_integer(what) or types.is_floating(what),
            "true or false": types.is_boolean(what),
        }[kind]
    )


def read_folders(paths: Sequence[Path]) -> list[Folder]:
    """Read results folders. Raises InputError, a line for each that cannot be, or that is given twice."""
    folders: list[Folder] = []
    problems: list[str] = []
    seen: dict[Path, Path] = {}
    for path in paths:
        if path.resolve() in seen:
            problems.append(f"{path}: expected each folder once, found it twice ({seen[path.resolve()]})")
            continue
        seen[path.resolve()] = path
        try:
            folders.append(read_folder(path))
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    if not folders:
        raise InputError("compare: expected a results folder, found none")
    return folders
