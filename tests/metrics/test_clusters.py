"""What intervals are over: logs from three on, the objects of one log, the runs of one object; never objects of two."""

from __future__ import annotations

import pandas as pd
import pytest

from copem_replay.metrics.intervals import choose_clusters


def rows(logs: int, objects: int, runs: int = 2) -> pd.DataFrame:
    """Objects of the same names in every log."""
    found = [(f"log {a}", str(b), run) for a in range(logs) for b in range(objects) for run in range(runs)]
    return pd.DataFrame(found, columns=["log", "object_id", "run"])


@pytest.mark.parametrize(
    ("logs", "objects", "over", "many"),
    [
        (1, 1, "runs", 2),
        (2, 1, None, 2),
        (2, 9, None, 18),  # objects of one name in two logs are two
        (1, 4, None, 4),
        (1, 5, "objects", 5),
        (3, 1, "logs", 3),
        (3, 9, "logs", 3),
    ],
)
def test_what_intervals_are_over(logs: int, objects: int, over: str | None, many: int) -> None:
    found, cluster = choose_clusters(rows(logs, objects))
    assert found == over
    assert cluster.nunique() == many
    assert len(cluster) == logs * objects * 2
