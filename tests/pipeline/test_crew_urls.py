"""Workers fetch logs and keep pieces under URLs; the command finds them there."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from tests.cli.test_api import cr
from tests.helpers.experiments import drive
from tests.helpers.object_storage import Bucket
from tests.pipeline.test_pieces import replayed, study


def test_a_crew_reads_and_keeps_under_urls(bucket: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        bucket.put(drive(tmp_path / f"d/{name}.mcap"), f"d/{name}.mcap")
    plain, computed, _ = replayed(study("logs: ['d/*.mcap']", runs=5), "plain")
    Path("e.yaml").write_text(study(f"logs: ['{bucket.url}/d/*.mcap']", runs=5))
    before = len(bucket.requests())
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as crew:
        result = cr.run("e.yaml", pieces=f"{bucket.url}/kept", crew=crew)
    fetched = [path for _, path in bucket.requests()[before:] if path.endswith(".mcap")]
    assert {Path(path).name for path in fetched} == {"a.mcap", "b.mcap"}
    result.save("out")
    store = result.replayed.logs[0].pieces
    assert store is not None
    assert (store.computed, store.found) == (computed, 0)
    for name in ("summary.csv", "detections.parquet", "tally.parquet", "bands.csv"):
        assert Path("out", name).read_bytes() == plain[name]
