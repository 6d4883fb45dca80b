"""Ghosts and outages in what is written: MCAP, .rrd and report, in one piece and in time chunks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import copem_replay as cr
from copem_replay.pipeline import prepare as chunking
from tests.helpers.experiments import changed, drive
from tests.viewer.test_rrd import rows

CONFIGURATIONS = "configurations: {PEM: {units: all}, gnn: {units: all, fusion: {kind: gnn}}}"
TEXT = (
    changed(CONFIGURATIONS, "show: {run: 0}", "runs: 2")
    .replace("  onboard:\n", "  eyes: PLACE\n  onboard:\n")
    .replace("  coPEM: {units: all, latency_s: 0.5}\n", "")
    .replace("  GT: {units: truth}\n", "")
    .replace("  PEM: {units: [ego]}\n", "")
    .replace("height_m: 5.0, pem: onboard", "height_m: 5.0, pem: eyes, outages: {down_share: 0.4, lasts_s: 0.5}")
)
EYES = """
    couples: [{detection: {kind: constant, probability: 0.5}}]
    ghosts:
      - {in_list: 1, lasts_s: 0.5, where: {kind: field, range_m: [3, 30]}}
      - {in_list: 1, where: {kind: beside, classes: [truck], within_m: 2}}"""


def replayed(folder: Path) -> Path:
    drive(folder / "drive.mcap")
    (folder / "experiment.yaml").write_text(TEXT.replace(" PLACE", EYES), encoding="utf-8")
    out = folder / "out"
    cr.run(folder / "experiment.yaml").save(out)
    return out


def details(out: Path, configuration: str) -> list[dict[str, Any]]:
    with (out / "replay.mcap").open("rb") as file:
        topic = f"copem/{configuration}/detail"
        return [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=[topic])]


@pytest.mark.parametrize("chunks", [False, True])
def test_they_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunks: bool) -> None:
    if chunks:
        monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
        monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 60)
    out = replayed(tmp_path)
    gnn, ideal = details(out, "gnn"), details(out, "PEM")
    false = [ghost for message in gnn for ghost in message["ghosts"]]
    assert false
    assert {ghost["unit"] for ghost in false} == {"mast"}
    assert not any(message["ghosts"] for message in ideal)
    assert [message["down"] for message in gnn] == [message["down"] for message in ideal]
    down = [message["captured_ns"] for message in gnn if message["down"] == ["mast"]]
    assert 0 < len(down) < len(gnn)
    assert not {ghost["captured_ns"] for ghost in false} & set(down)
    shown = rows(out / "replay.rrd", "/world/units/mast/ghosts")
    places = np.array([place for row in shown for place in row["Points3D:positions"]])
    assert np.allclose(np.sort(places[:, 0]), np.sort([ghost["x_m"] for ghost in false]), atol=1e-4)
    assert rows(out / "replay.rrd", "/world/units/mast/outage")


def test_the_report_and_the_notes_say_so(tmp_path: Path) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "experiment.yaml").write_text(TEXT.replace(" PLACE", EYES), encoding="utf-8")
    result = cr.run(tmp_path / "experiment.yaml")
    assert "drive: pems.eyes.ghosts[1].where: beside: no truck in this log" in result.notes
    result.save(tmp_path / "out")
    cr.write_report(tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert (
        "Unit mast: no lists 40 % of the time, 0.5 s at a time on average, 2 false entries in a list on average" in page
    )
