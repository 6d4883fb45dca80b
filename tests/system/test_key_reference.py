"""The reference of the experiment's keys is current, and shows every key."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from copem_replay.experiment.schema import Experiment

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from key_reference import PAGE, Reference  # noqa: E402

PARTS = list(YAML(typ="safe", pure=True).load_all((ROOT / "tools/key_examples.yaml").read_text(encoding="utf-8")))


def test_the_page_is_what_the_tool_writes_and_every_key_has_an_example() -> None:
    reference = Reference()
    assert reference.without_example() == []
    assert PAGE.read_text(encoding="utf-8") == reference.page(), "python tools/key_reference.py"


@pytest.mark.parametrize("part", PARTS, ids=range(len(PARTS)))
def test_examples_are_experiments(part: dict[str, Any]) -> None:
    """But for own components and recorded latencies, whose files are not there."""
    part = {**part, "configurations": dict(part.get("configurations", {"gnn": {"units": "truth"}}))}
    part["configurations"].pop("own link", None)
    links = part.get("links", {})
    part["links"] = {name: link for name, link in links.items() if link.get("latency", {}).get("kind") != "recorded"}
    part["measure"] = {key: value for key, value in part["measure"].items() if key != "metrics"}
    experiment = Experiment.model_validate({"version": 1, "logs": ["a.mcap"], **part})
    assert set(experiment.configurations) == set(part["configurations"])
