"""The schema has every column of every file as it is written, in its order; the reference of the columns is current."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet
from ruamel.yaml import YAML

import copem_replay as cr
from copem_replay.metrics.columns import COMPARISON, TABLES
from copem_replay.metrics.summary_metrics import METRIC

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from column_reference import PAGE, page  # noqa: E402

CHANGES: dict[str, Any] = {
    "runs": 3,
    "logs": [str(ROOT / "logs/tc016d.mcap")],
    "sweep": {"latency_s": [1.0]},
    "show": None,
    "window_s": [0.0, 8.0],
}
FLEET = {"on": {"classes": ["truck"], "penetration_rate": 0.5}, "pem": "onboard"}  # so runs differ in their instants
ABSENT = {"summary.csv": {"output", "link"}, "provenance.json": {"label"}}
"""By file what is there `when` a configuration has what none has here, the output of a stack, links; or `run` a label.
"""
JSON = {str: "text", int: "whole number", float: "number", dict: "by name", list: "list"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with every file, and every column but those of links and recorded outputs."""
    data = YAML(typ="safe", pure=True).load((ROOT / "logs/tc016d.yaml").read_text(encoding="utf-8")) | CHANGES
    data["units"]["fleet"] = FLEET
    data["measure"]["conflict"] = {"horizon_s": 3.0}
    data["measure"]["by"] = ["class"]
    data["areas"] = {"here": {"polygon_m": [[0, 0], [9, 0], [9, 9]]}}
    data["units"]["ego"]["ready"] = 0.0  # so lists have a way that is told
    return cr.run(data).save(tmp_path_factory.mktemp("results") / "out")


def kind(found: pa.DataType) -> str:
    if pa.types.is_list(found) or pa.types.is_large_list(found):
        return f"lists of {kind(found.value_type)}"
    if pa.types.is_boolean(found):
        return "true or false"
    return "whole numbers" if pa.types.is_integer(found) else "numbers" if pa.types.is_floating(found) else "text"


def written(path: Path) -> dict[str, str]:
    """Names and kinds of what a file has."""
    if path.suffix == ".parquet":
        return {field.name: kind(field.type) for field in parquet.read_schema(path)}
    if path.suffix == ".json":
        return {name: JSON[type(value)] for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
    return {name: "numbers" if column.dtype.kind in "if" else "text" for name, column in pd.read_csv(path).items()}


def test_files_have_the_columns_of_the_schema_in_their_order(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {*TABLES, "experiment.yaml"}
    for name, table in TABLES.items():
        expected = {
            c.name: c.kind.removesuffix(" or null") for c in table.columns if c.when not in ABSENT.get(name, ())
        }
        found = written(folder / name)
        if name in ("sweep.csv", "summary_by.csv"):  # the others are those of the summary
            found = {column: of for column, of in found.items() if column not in METRIC}
        assert list(found) == list(expected), name
        if name.endswith(".csv"):  # a column of nothing but nulls is one of numbers there
            expected = {column: of.replace("whole ", "") for column, of in expected.items()}
            found |= {"reason": "text"} if name == "logs.csv" else {}
            found |= {"apart": "true or false", "note": "text"} if name == "summary_by.csv" else {}
        assert found == expected, name


def test_the_page_is_what_the_tool_writes_and_every_column_is_described() -> None:
    made = page()
    assert PAGE.read_text(encoding="utf-8") == made, "python tools/column_reference.py"
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| (.*) \|$", made, re.MULTILINE)
    assert len(rows) == sum(len(table.columns) for table in (*TABLES.values(), COMPARISON))
    assert [row for row in rows if not row[3]] == []
