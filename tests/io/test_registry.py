"""Formats from outside the package: a message schema by a row and an entry point, a container by a row."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.io.test_world_frame import own_recording

MODULE = """
from copem_replay.io.schemas.description import Description, Fields
from copem_replay.io.schemas.registry import ListSchema


def describe(offers):
    assert "boxes[].pos[]" in offers
    return Description(
        Fields.model_validate(
            {
                "objects": "boxes[]",
                "stamp": "header.t",
                "frame": "header.frame",
                "id": "track.id",
                "class": {"path": "label", "map": {"2": "pedestrian", "5": "truck"}},
                "x_m": "pos[0]",
                "y_m": "pos[1]",
                "length_m": "dims[0]",
                "width_m": "dims[1]",
                "height_m": "dims[2]",
            }
        )
    )


def fails(offers):
    raise ValueError("no such thing")


def other(offers):
    return {"objects": "boxes[]"}


BOXES = ListSchema("my.Boxes", "own_boxes:describe")
WITHOUT_IDS = ListSchema("my.Boxes", "own_boxes:describe", has_ids=False)
FAILS = ListSchema("my.Boxes", "own_boxes:fails")
OTHER = ListSchema("my.Boxes", "own_boxes:other")
NO_FUNCTION = ListSchema("my.Boxes", "own_boxes:gone")
"""


def with_row(folder: Path, row: str | None) -> dict[str, str]:
    """The environment in which a distribution is installed that has the schema."""
    (folder / "own_boxes.py").write_text(MODULE)
    if row is not None:
        made = folder / "own_boxes-1.0.dist-info"
        made.mkdir()
        (made / "METADATA").write_text("Metadata-Version: 2.1\nName: own-boxes\nVersion: 1.0\n")
        (made / "entry_points.txt").write_text(f"[copem_replay.list_schema]\nmy.Boxes = own_boxes:{row}\n")
    return os.environ | {"PYTHONPATH": str(folder)}


def call(folder: Path, row: str | None, *words: str | Path) -> subprocess.CompletedProcess[str]:
    main = "from copem_replay.cli.main import main; main()"
    command = [sys.executable, "-c", main, *words, own_recording(folder)]
    return subprocess.run(command, env=with_row(folder, row), capture_output=True, text=True, check=False, timeout=120)


def test_a_schema_of_another_package_is_the_truth(tmp_path: Path) -> None:
    done = call(tmp_path, "BOXES", "info", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    (found,) = json.loads(done.stdout)
    assert [(t["schema"], t["role"]) for t in found["topics"]] == [("my.Boxes", "truth")]
    assert found["truth"][0]["moving"] == {"truck": 1, "pedestrian": 1}


def test_without_the_package_the_schema_is_unknown(tmp_path: Path) -> None:
    done = call(tmp_path, None, "info", "--json")
    (found,) = json.loads(done.stdout)
    assert (done.returncode, found["readable"]) == (2, False)
    assert found["topics"][0]["role"] == "unread"


def test_lists_without_ids_are_those_of_a_unit(tmp_path: Path) -> None:
    (found,) = json.loads(call(tmp_path, "WITHOUT_IDS", "info", "--json").stdout)
    assert not found["readable"]
    assert found["topics"][0]["role"] == "unit"


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ("GONE", "schema my.Boxes: own_boxes:GONE cannot be imported: AttributeError: "),
        ("describe", "schema my.Boxes: expected own_boxes:describe to be a ListSchema, found function"),
        ("FAILS", "schema my.Boxes: own_boxes:fails: ValueError: no such thing ("),
        ("OTHER", "schema my.Boxes: expected own_boxes:other to give a Description, found dict"),
        ("NO_FUNCTION", "schema my.Boxes: own_boxes:gone cannot be imported: AttributeError: "),
    ],
)
def test_a_row_that_is_none_is_one_line(tmp_path: Path, row: str, expected: str) -> None:
    done = call(tmp_path, row, "info")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(expected)
