"""What intervals are over: logs from three on, objects of one log, passes or runs of one object; never those of two."""

from __future__ import annotations

import pandas as pd
import pytest

from copem_replay.metrics.limits import find_clusters


def rows(logs: int, objects: int, passes: int = 1, runs: int = 2) -> pd.DataFrame:
    """Objects of the same names in every log, each with its passes."""
    found = [
        (f"log {a}", str(b), c, run)
        for a in range(logs) for b in range(objects) for c in range(passes) for run in range(runs)
    ]  # fmt: skip
    return pd.DataFrame(found, columns=["log", "object_id", "episode", "run"])


@pytest.mark.parametrize(
    ("logs", "objects", "passes", "over", "many", "units"),
    [
        (1, 1, 1, "runs", 2, 1),
        (1, 1, 4, "runs", 2, 4),  # four passes of one object: runs, counted as runs
        (1, 1, 5, "passes", 5, 5),
        (2, 1, 9, None, 0, 0),
        (2, 9, 1, None, 0, 0),  # objects of one name in two logs are two
        (1, 4, 9, None, 0, 0),
        (1, 5, 1, "objects", 5, 5),
        (1, 5, 3, "objects", 5, 5),  # an object is a cluster with all its passes
        (3, 1, 9, "logs", 3, 3),
        (3, 9, 1, "logs", 3, 27),
    ],
)
def test_what_intervals_are_over(logs: int, objects: int, passes: int, over: str | None, many: int, units: int) -> None:
    found = find_clusters(rows(logs, objects, passes))
    if over is None:
        assert found is None
        return
    assert found is not None
    assert (found.over, found.count, found.units, len(found.number)) == (over, many, units, logs * objects * passes * 2)
    half = found.select(found.number < 2)
    assert (half.over, half.count) == (over, 2)


def test_rows_of_a_tally_of_one_object_are_one_cluster_of_runs() -> None:
    found = find_clusters(rows(1, 1, 4).drop(columns="run"))
    assert found is not None
    assert (found.over, found.count, found.units) == ("runs", 1, 4)
