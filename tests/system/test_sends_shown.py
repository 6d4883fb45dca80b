"""Messages that leave objects out, in what is written for viewers: an entry shown is as old as it was sent."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader

import copem_replay as cr
from copem_replay.pipeline import prepare as chunking
from tests.helpers.experiments import changed, drive
from tests.viewer.test_rrd import rows

CONFIGURATIONS = "configurations: {PEM: {units: [mast]}, gnn: {units: [mast], fusion: {kind: gnn}}}"
TEXT = (
    changed(CONFIGURATIONS, "show: {run: 0}", "runs: 2")
    .replace("  coPEM: {units: all, latency_s: 0.5}\n", "")
    .replace("  GT: {units: truth}\n", "")
    .replace("  PEM: {units: [ego]}\n", "")
    .replace("height_m: 5.0, pem: onboard", "height_m: 5.0, pem: onboard, sends: {kind: cpm, interval_s: 0.2}")
    .replace("probability: 0.5", "probability: 1.0")
)


@pytest.mark.parametrize("chunks", [False, True])
def test_they_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunks: bool) -> None:
    if chunks:
        monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
        monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 60)
    drive(tmp_path / "drive.mcap")
    (tmp_path / "experiment.yaml").write_text(TEXT, encoding="utf-8")
    out = tmp_path / "out"
    result = cr.run(tmp_path / "experiment.yaml")
    result.save(out)
    assert result.summary.set_index("configuration").list_rate_hz.tolist() == pytest.approx([5.0, 5.0])
    for name in ("PEM", "gnn"):
        with (out / "replay.mcap").open("rb") as file:
            messages = [m for _, _, m in make_reader(file).iter_messages(topics=[f"copem/{name}/detail"])]
        lists = [json.loads(message.data)["objects"] for message in messages]
        assert [len(objects) for objects in lists] == [2] * 16
        assert {len(row["Boxes3D:centers"]) for row in rows(out / "replay.rrd", f"/world/{name}/boxes")} == {2}
        if name == "PEM":  # the parked car, every 0.2 s as it was last sent, after 0, 1, 2 and 3 s
            captured = [of["captured_ns"][0] for objects in lists for of in objects if of["id"] == "3"]
            assert captured == [k // 5 * 10**9 for k in range(16)]
