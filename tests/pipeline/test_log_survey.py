"""Logs are read one after the other: however many there are, few are in memory, and results are the same bytes."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import pytest

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Tracks
from copem_replay.experiment import validate
from copem_replay.pipeline import cost as memory
from copem_replay.pipeline import study_log as log_survey
from tests.cli.test_api import cr
from tests.helpers.experiments import changed, drive
from tests.pipeline.test_parts import EXACT, FLEET, replayed, study


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in "abcd":
        drive(tmp_path / f"{name}.mcap")
    return tmp_path


@pytest.mark.parametrize(
    "text",
    [
        study("logs: ['[a-d].mcap']", gnn=True),
        study("logs: ['[a-d].mcap']", EXACT, "sweep: {latency_s: [0, 0.3], units: [1]}"),
        study("logs: ['[a-d].mcap']", FLEET, "show: {run: worst, logs: [all]}", runs=7),
        study("logs: [a.mcap, {file: b.mcap, window_s: [0, 2]}, {file: c.mcap, units: {mast: null}}]", runs=7),
    ],
    ids=["fusions", "exact and swept", "fleet, shown", "settings"],
)
@pytest.mark.parametrize("kept", [None, "kept"])
def test_the_same_bytes_from_logs_that_stay_and_from_logs_that_are_read_again(
    text: str, kept: str | None, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, _, _ = replayed(text, "plain", None)
    monkeypatch.setattr(log_survey, "STATES_HELD", 0)
    assert replayed(text, "again", kept)[0] == plain


@pytest.mark.parametrize("kept", [None, "kept"])
def test_few_logs_are_in_memory_at_a_time(kept: str | None, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten logs, one worker: the first, which stays, the one that is replayed, and the next."""
    for k in range(10):
        (here / f"name{k}.mcap").hardlink_to(here / "a.mcap")
    monkeypatch.setattr(log_survey, "STATES_HELD", 0)
    there: list[weakref.ref[Tracks]] = []
    most, read = 0, validate.read_log

    def watched(*given: Any, **keys: Any) -> Any:
        nonlocal most
        most = max(most, sum(one() is not None for one in there))
        recording = read(*given, **keys)
        there.append(weakref.ref(recording.truth))
        return recording

    monkeypatch.setattr(validate, "read_log", watched)
    Path("e.yaml").write_text(study("logs: [name*.mcap]", "sweep: {latency_s: [0, 0.3]}", runs=3))
    cr.run("e.yaml", jobs=1, pieces=kept).save("out")
    assert len(there) > 19, "each but the first is read twice"
    assert most <= 3


def test_all_that_is_wrong_is_said_before_any_run(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_survey, "STATES_HELD", 0)
    twice = "measure: {onset: {kind: appears}, began: [log_start, appeared], confirm: {hits: 2, of: 2}, exact: true}"
    Path("e.yaml").write_text(study("logs: ['[a-d].mcap']", twice).replace("latency_s: 0.5", "latency_s: {mast: 0.03}"))
    done: list[int] = []
    with pytest.raises(InputError, match=r"e.yaml:\d+: measure.exact: .* no closed form") as wrong:
        cr.run("e.yaml", progress=lambda at, _: done.append(at))
    assert len(wrong.value.problems) == 1
    assert done == []


def test_the_memory_of_all_rows_counts_whatever_stays(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = changed("runs: 1000000", "logs: ['[a-d].mcap']")
    Path("e.yaml").write_text(text)
    monkeypatch.setattr(memory, "free_bytes", lambda: 10**8)
    said = []
    for held in (10**6, 0):
        monkeypatch.setattr(log_survey, "STATES_HELD", held)
        with pytest.raises(InputError, match="1000000 runs of 12 rows each take at least") as error:
            cr.run("e.yaml")
        said.append(str(error.value))
    assert said[0] == said[1]
