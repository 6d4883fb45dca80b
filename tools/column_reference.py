"""Write the reference of the columns of a results folder: docs/reference/columns.md.

python tools/column_reference.py

Names and types are those of real results: `logs/tc016d.yaml` in three runs, with all that adds columns. Words are, the
first that there is: those of tools/column_words.yaml, the `help` of a metric of the summary, the tables of the guide.
"""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
from pyarrow import parquet
from ruamel.yaml import YAML

import copem_replay as cr
from copem_replay.metrics.summary_metrics import METRIC
from key_reference import ROOT, unit_of

PAGE = ROOT / "docs/reference/columns.md"
HEAD = """\
# Columns of a results folder

Made by `tools/column_reference.py` from results and the words of the code and the guide. What the files are:
[results.md](../guide/results.md). Null: it does not exist; in CSV an empty cell.
"""
_READER = YAML(typ="safe", pure=True)
_WORDS: dict[str, dict[str, str]] = _READER.load((ROOT / "tools/column_words.yaml").read_text(encoding="utf-8"))
_CHANGES: dict[str, Any] = {
    "runs": 3,
    "logs": [str(ROOT / "logs/tc016d.mcap")],
    "sweep": {"latency_s": [1.0]},
    "show": None,
    "window_s": [0.0, 8.0],
}
_FLEET = {"on": {"classes": ["truck"], "penetration_rate": 0.5}, "pem": "onboard"}  # so runs differ in their instants
_JSON = {str: "text", int: "whole number", float: "number", dict: "by name", list: "list", type(None): "section"}


def results(folder: Path) -> Path:
    """Results with every file and column but those of links and recorded outputs, which are metrics of the summary."""
    data = _READER.load((ROOT / "logs/tc016d.yaml").read_text(encoding="utf-8")) | _CHANGES
    data["units"]["fleet"] = _FLEET
    data["measure"]["conflict"] = {"horizon_s": 3.0}
    data["units"]["ego"]["ready"] = 0.0  # so lists have a way that is told
    cr.run(data).save(folder / "out")
    return folder / "out"


def columns(path: Path) -> dict[str, str]:
    """Names and types of the columns, or keys, of a file."""
    if path.suffix == ".parquet":
        return {field.name: _type(field.type) for field in parquet.read_schema(path)}
    if path.suffix == ".json":
        return {name: _JSON[type(value)] for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
    table = pd.read_csv(path)
    found = {name: "number" if table[name].dtype.kind in "if" else "text" for name in table}
    if path.name == "sweep.csv":
        return {name: kind for name, kind in found.items() if name not in METRIC}
    every = ["configuration", *METRIC] if path.name == "summary.csv" else list(found)
    return {name: found.get(name, "number") for name in every}


def words(file: str, name: str) -> str:
    """What a column means; empty: nothing says so."""
    return (_GUIDE | _HELP | _WORDS["any"] | _WORDS.get(file, {})).get(name, "")


def _type(kind: pa.DataType) -> str:
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return f"list of {_type(kind.value_type)}s"
    if pa.types.is_boolean(kind):
        return "true or false"
    return "whole number" if pa.types.is_integer(kind) else "number" if pa.types.is_floating(kind) else "text"


def _of_guide() -> dict[str, str]:
    """By column the text of the guide's tables; links lead from the page."""
    found: dict[str, str] = {}
    text = (ROOT / "docs/guide/metrics.md").read_text(encoding="utf-8")
    for table in re.findall(r"^\| column.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE):
        for names, meaning in re.findall(r"^\| (`.*?) \| (.*) \|$", table, re.MULTILINE):
            meaning = re.sub(r"\]\((#|(?=[\w-]+\.md))", r"](../guide/\1", meaning).replace(
                "guide/#", "guide/metrics.md#"
            )
            found |= dict.fromkeys(re.findall(r"`(\w+)`", names), meaning)
    return found


_GUIDE = _of_guide()
_HELP = {name: metric.help for name, metric in METRIC.items()}


def page() -> str:
    """The whole page. Raises KeyError for a file without a section."""
    with tempfile.TemporaryDirectory() as folder:
        files = {path.name: columns(path) for path in results(Path(folder)).iterdir() if path.suffix != ".yaml"}
    parts = [HEAD]
    for file in sorted(files, key=list(_WORDS["files"]).index):
        parts += [
            f"## `{file}`\n",
            f"{_WORDS['files'][file]}\n",
            "| column | type | unit | meaning |",
            "|---|---|---|---|",
        ]
        for name, kind in files[file].items():
            unit = unit_of(re.sub(r"_(low|high|exact)$", "", name)) if "number" in kind else ""
            parts.append(f"| `{name}` | {kind} | {unit} | {words(file, name)} |")
        parts[-1] += "\n"
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE.relative_to(ROOT)}")
