"""A log in stretches gives what it gives in one piece, to the last bit."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest

from copem_replay import stretches
from copem_replay.check import problems, read_logs
from copem_replay.experiment import Experiment
from copem_replay.experiment_file import load, log_paths
from copem_replay.run import Result, run

LOGS = Path(__file__).parents[1] / "logs"


def results(experiment: Experiment, recordings: list, rows: int, monkeypatch: pytest.MonkeyPatch) -> Result:
    pieces = rows > 0
    with monkeypatch.context() as patch:
        if pieces:
            patch.setattr(stretches, "ROWS_AT_ONCE", 1)
            patch.setattr(stretches, "ROWS_A_STRETCH", rows)
        done = run(experiment, recordings)
        assert (len(done.replays[0].stretches) > 1) is pieces
    return done


def assert_same(one: Result, other: Result) -> None:
    pd.testing.assert_frame_equal(one.table, other.table, check_exact=True)
    pd.testing.assert_frame_equal(one.summary, other.summary, check_exact=True)
    assert one.notes == other.notes
    assert (one.accuracy is None) == (other.accuracy is None)
    if one.accuracy is not None and other.accuracy is not None:
        pd.testing.assert_frame_equal(one.accuracy.bands, other.accuracy.bands, check_exact=True)
        for name in ("accuracy", "instants", "lists", "thresholds"):
            mine, theirs = getattr(one.accuracy, name), getattr(other.accuracy, name)
            assert (mine is None) == (theirs is None)
            assert mine is None or (isinstance(mine, pa.Table) and mine.equals(theirs))


@pytest.mark.parametrize(("name", "rows", "configurations"), [("tc016d", 1500, None), ("crossing", 50_000, 9)])
def test_in_pieces_as_in_one(name: str, rows: int, configurations: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    source = load(LOGS / f"{name}.yaml")
    experiment, found = problems(source)
    assert experiment is not None, found
    chosen = dict(list(experiment.configurations.items())[:configurations])
    experiment = experiment.model_copy(update={"runs": 2, "configurations": chosen})
    recordings, _ = read_logs(experiment, log_paths(source)[0], source)
    assert_same(results(experiment, recordings, 0, monkeypatch), results(experiment, recordings, rows, monkeypatch))
