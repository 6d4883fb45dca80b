"""The tally: what runs have in common is counted once, and the summary of it is that of the rows, to the last bit."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.metrics.summary import summarise_rows, tally_rows
from tests.helpers.drawn import examples
from tests.oracles.intervals import exact
from tests.oracles.summary import figures

REASONS = ("object_left", "ego_left", "log_end")


@st.composite
def tables(draw: st.DrawFn) -> pd.DataFrame:
    """Rows of several logs, configurations, objects and runs: ties, gaps of the truth, objects known before."""
    runs, logs = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    whole = st.integers(-3, 9)
    rows = []
    for log in range(logs):
        for k in range(draw(st.integers(1, 3))):
            onset, length = draw(st.integers(0, 40)) / 8, draw(st.integers(1, 80)) / 10
            base = {"log": f"log {log}", "object_id": str(k), "object_class": "car", "episode": 0, "onset_s": onset,
                    "ended_s": onset + length, "ended_by": draw(st.sampled_from(REASONS)),
                    "conflict": draw(st.booleans())}  # fmt: skip
            gap = draw(whole)  # the truth has a gap there: no distance
            for name in "ab":
                for run in range(runs):
                    row = base | {"configuration": name, "run": run, "braking_pass": draw(st.booleans())}
                    for event, to in (("", "to"), ("conflict_", "to_conflict")):
                        tick = draw(st.none() | whole)
                        known, time_s = tick is not None, np.nan if tick is None else tick / 10
                        row |= {
                            f"{event}detected": known,
                            f"{event}detection_s": onset + time_s,
                            f"time_{to}_detection_s": onset + time_s - onset,
                            f"distance_at_{event}detection_m": np.nan if tick in (None, gap) else 30.1 - 2 * tick,
                        }
                    rows.append(row)
    table = pd.DataFrame(rows)
    passes = pd.array(table["braking_pass"], dtype="boolean")
    passes[~table["conflict"].to_numpy()] = pd.NA
    return table.assign(braking_pass=passes)


@settings(max_examples=examples(100))  # each is a table of many rows
@given(tables())
def test_the_summary_of_the_tally_is_that_of_the_rows(table: pd.DataFrame) -> None:
    found, _ = summarise_rows(table, ["a", "b"], {"a": 1.0, "b": 2.0}, horizon_s=7.3)
    for name, row in found.set_index("configuration").iterrows():
        rows = table[table["configuration"] == name]
        for metric, value in (figures(rows, 7.3) | figures(rows, 7.3, "conflict_")).items():
            summed = metric.startswith("unknown_")  # in another order
            rounded = pytest.approx(value, abs=1e-12) if summed else value
            assert row[metric] == rounded or (value is None and pd.isna(row[metric])), metric
        judged = rows[rows["conflict"]]
        assert (row["n"], row["n_conflict"]) == (len(rows), len(judged))
        if len(judged):
            assert row["pass_share"] == judged["braking_pass"].to_numpy(dtype=bool).mean()
        if row["interval_over"] == "runs":
            assert (row["detected_share_low"], row["detected_share_high"]) == pytest.approx(
                exact(rows["detected"].mean(), len(rows))
            )


@settings(max_examples=examples(100))
@given(tables(), st.randoms(use_true_random=False))
def test_counts_are_those_of_the_rows_in_whatever_order(table: pd.DataFrame, random: object) -> None:
    found = tally_rows(table)
    keys = ["log", "configuration", "object_id", "time_to_detection_s"]
    for event, to in (("detected", "to"), ("conflict", "to_conflict")):
        mine = found[found["event"] == event].set_index(keys)["runs"]
        named = table.assign(time_to_detection_s=table[f"time_{to}_detection_s"])
        pd.testing.assert_series_equal(
            mine.sort_index(), named.groupby(keys, dropna=False).size().sort_index(), check_names=False
        )
    assert found["passed"].sum() == 2 * table["braking_pass"].fillna(False).sum()
    mixed = tally_rows(table.sample(frac=1, random_state=random.randrange(1000)))  # type: ignore[attr-defined]
    order = ["log", "configuration", "event", "object_id", "time_to_detection_s"]
    pd.testing.assert_frame_equal(*(one.sort_values(order, ignore_index=True) for one in (found, mixed)))


def test_rows_are_by_log_configuration_event_object_and_instant() -> None:
    base = {"object_class": "car", "episode": 0, "onset_s": 1.0, "ended_s": 5.0, "ended_by": "log_end"}
    rows = [
        base | {"log": log, "configuration": name, "run": run, "object_id": thing, "detected": s is not None,
                "detection_s": s, "time_to_detection_s": None if s is None else s - 1, "distance_at_detection_m": s}
        for log in "ba"
        for name in ("z", "y")
        for run, seen in enumerate([(2.0, None), (1.5, None), (2.0, 4.0)])
        for thing, s in zip(("9", "10"), seen, strict=True)
    ]  # fmt: skip
    found = tally_rows(pd.DataFrame(rows).astype({"detection_s": float, "time_to_detection_s": float}))
    assert found["log"].tolist() == ["b"] * 8 + ["a"] * 8
    assert found["configuration"].tolist() == (["z"] * 4 + ["y"] * 4) * 2
    first = found.iloc[:4]
    assert first["object_id"].tolist() == ["9", "9", "10", "10"]
    assert first["detection_s"].fillna(-1).tolist() == [1.5, 2.0, 4.0, -1]
    assert first["runs"].tolist() == [1, 2, 1, 2]
    assert "in_conflict" not in found


@pytest.mark.parametrize("conflicts", [False, True])
def test_without_rows_there_is_no_figure_and_no_column_more(conflicts: bool) -> None:
    columns = ["log", "configuration", "run", "object_id", "episode", "onset_s", "ended_s", "ended_by", "detected",
               "detection_s", "time_to_detection_s", "distance_at_detection_m"]  # fmt: skip
    more = ["conflict_detected", "conflict_detection_s", "time_to_conflict_detection_s",
            "distance_at_conflict_detection_m"] if conflicts else []  # fmt: skip
    found, _ = summarise_rows(pd.DataFrame(columns=columns + more), ["a"], {"a": None}, horizon_s=None)
    assert (found["n"].tolist(), found["detected_share"].tolist()) == ([0], [None])
    assert ("conflict_detected_share" in found) == conflicts
