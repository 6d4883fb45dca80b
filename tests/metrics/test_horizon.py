"""How far episodes are followed: 5 s, or as asked, and shorter where too few last that long, by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest

from copem_replay.metrics.summary import settle_horizon
from copem_replay.results.compare.compare import compare_folders
from tests.helpers.compare_folders import row, write_folder


def rows(lengths_s: Sequence[float]) -> pd.DataFrame:
    """Two rows of each episode, one per configuration."""
    return pd.DataFrame(
        {
            "log": "a",
            "configuration": name,
            "object_id": str(k),
            "episode": 0,
            "onset_s": 1.1,
            "ended_s": 1.1 + length_s,
        }
        for name in ("GT", "PEM")
        for k, length_s in enumerate(lengths_s)
    )


@pytest.mark.parametrize(
    ("lengths_s", "asked_s", "expected_s", "note"),
    [
        ([5.0], 5.0, 5.0, None),  # the paper's: 1.1 + 5.0 − 1.1 is less than 5 by rounding
        ([4.0], 5.0, 4.0, "0 of 1 episode that count (0 %) last 5 s; so times count up to 4 s, which 1 "
         "of them last"),
        ([9.0, 3.0], 5.0, 5.0, None),  # half of two
        ([9.0, 3.0, 2.0], 5.0, 3.0, "1 of 3 episodes that count (33.3 %) last 5 s; so times count up to 3 s, which "
         "2 of them last"),
        ([9.0, 8.0, 1.0, 1.0], 5.0, 5.0, None),
        ([9.0, 8.0, 7.0, 6.0, 2.0], 5.0, 2.0, "4 of 5 episodes that count (80 %) last 5 s; so times count up to "
         "2 s, which 5 of them last"),
        ([9.0] * 5 + [1.0] * 45, 5.0, 5.0, None),  # five, and a tenth of fifty
        ([9.0] * 5 + [1.0] * 46, 5.0, 1.0, "5 of 51 episodes that count (9.8 %) last 5 s; so times count up to 1 s, "
         "which 6 of them last"),
        ([9.0] * 6 + [1.0] * 54, 8.5, 8.5, None),
        ([9.0] * 8, 100.0, 9.0, "0 of 8 episodes that count (0 %) last 100 s; so times count up to 9 s, which 5 of "
         "them last"),
        ([], 5.0, 5.0, None),
    ],
)  # fmt: skip
def test_the_horizon(lengths_s: list[float], asked_s: float, expected_s: float, note: str | None) -> None:
    table = (
        rows(lengths_s) if lengths_s else pd.DataFrame(columns=["log", "object_id", "episode", "onset_s", "ended_s"])
    )
    found_s, notes = settle_horizon(table, asked_s)
    assert found_s == pytest.approx(expected_s, abs=1e-9)
    assert notes == ([] if note is None else [f"horizon_s: {note}"])


def test_objects_of_one_name_in_two_logs_are_two() -> None:
    tables = [rows([9.0, 3.0]).assign(log=log) for log in ("a", "b")]
    assert settle_horizon(pd.concat(tables), 5.0) == (5.0, [])


def test_folders_are_compared_up_to_the_shorter(tmp_path: Path) -> None:
    """Known after 1 s and never: up to 10 s that is 9 s of difference, up to 4 s it is 3 s."""
    rows = [row("late", 1.0)], [row("late", None)]
    folders = [
        write_folder(tmp_path / name, of, measure={"horizon_s": s, "horizon_used_s": s})
        for name, of, s in zip(("one", "two"), rows, (10.0, 4.0), strict=True)
    ]
    found = compare_folders(folders)
    time = found.overall.set_index("metric").loc["ttd_rmst_s"]
    assert (found.horizon_s, time["difference"]) == (4.0, pytest.approx(3.0))
    assert f"other horizons ({folders[0]} 10 s, {folders[1]} 4 s): times are up to 4 s" in found.notes
