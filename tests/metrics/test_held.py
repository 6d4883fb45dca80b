"""What receivers hold at frames of the truth: by hand, against plain loops, and of configurations that are late."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.tracks import Tracks
from copem_replay.metrics.accuracy.held import (
    HeldAccuracy,
    HeldErrors,
    find_newest_lists,
    make_held_frames,
    thin_frames,
)
from copem_replay.metrics.accuracy.statistics import AccuracySettings
from copem_replay.metrics.episodes import Reference
from copem_replay.metrics.matching import Matches, match_entries
from copem_replay.results.compare import Comparison, compare_folders
from tests.helpers.replays import save_run
from tests.helpers.reports import between, chunks, entry, lists_of
from tests.helpers.reports import joined as one_list
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing
from tests.metrics.test_accuracy import Scenery, classes
from tests.oracles.accuracy import Places, episodes_of, matches_of, reference_of, scene_of, taken, truth_of
from tests.oracles.held import held_plainly, list_at
from tests.oracles.origin import unknown_origins

# Frames.


@pytest.mark.parametrize(
    ("frame_s", "kept_s"),
    [
        ([], []),
        ([0.0, 0.1, 0.2], [0.0, 0.1, 0.2]),
        ([0.0, 0.097, 0.204, 0.299, 0.4], [0.0, 0.097, 0.204, 0.299, 0.4]),  # 10 Hz, nearly
        ([k * 0.04 for k in range(11)], [0.0, 0.12, 0.2, 0.32, 0.4]),  # 25 Hz
        ([0.0, 0.5, 1.0], [0.0, 0.5, 1.0]),
        ([k / 12 for k in range(13)], [k / 12 for k in (0, 2, 3, 4, 5, 7, 8, 9, 10, 12)]),  # 12 Hz
        ([0.0, 0.02, 3.01, 3.04, 3.11], [0.0, 3.01, 3.11]),  # a gap is not made up for
    ],
)
def test_frames_are_thinned_to_ten_a_second(frame_s: list[float], kept_s: list[float]) -> None:
    assert thin_frames(np.array(frame_s)).tolist() == pytest.approx(kept_s)


@given(st.lists(st.floats(0.001, 0.3), max_size=60))
def test_of_any_frames_so_many_are_kept_and_none_that_is_needed_is_left_out(steps_s: list[float]) -> None:
    frame_s = np.cumsum(steps_s)
    kept_s = thin_frames(frame_s)
    assert kept_s[:1].tolist() == frame_s[:1].tolist()
    assert set(kept_s) <= set(frame_s)
    assert (np.diff(kept_s) >= 0.04 - 1e-9).all()
    if len(kept_s):
        assert len(kept_s) <= (kept_s[-1] - kept_s[0] + 0.01) / 0.1 + 1 + 1e-6
    for time_s in set(frame_s) - set(kept_s):
        assert time_s - max(t for t in kept_s if t < time_s) < 0.1


@given(st.lists(st.floats(0, 3), max_size=8), st.lists(st.floats(0, 4), max_size=12), st.sampled_from([0.1, 0.5, 2.0]))
def test_the_newest_list_is_held_until_it_is_too_old(issue_s: list[float], frame_s: list[float], age_s: float) -> None:
    issue_s, frame_s = sorted(issue_s), sorted(frame_s)
    newest, is_held = find_newest_lists(np.array(issue_s), np.array(frame_s), age_s)
    found = [int(k) if held else None for k, held in zip(newest, is_held, strict=True)]
    assert found == [list_at(issue_s, time_s, age_s) for time_s in frame_s]


# Errors, ages and GOSPA of lists written by hand.

EGO, CAR, OTHER_CAR = 0, 1, 2


def measured(
    *runs: Sequence[Any], issue_s: Sequence[float], frame_s: Sequence[float], places: Places,
    episodes: dict[int, tuple[float, float]], about: Matches | None = None, max_age_s: float = 1.0,
) -> HeldAccuracy:  # fmt: skip
    """Lists around an ego at the origin, GOSPA of cut-off 3 m. `about`: None: each tells of when it is issued."""
    lists, scene = lists_of(runs), scene_of("car", "car", "car")
    given_episodes, reference = episodes_of(episodes), reference_of([(0.0, 0.0)] * len(frame_s))

    def at(time_s: Any) -> Tracks:
        k = [list(frame_s).index(t) for t in time_s]
        return truth_of({o: [way[f] for f in k] for o, way in places.items()}, time_s)

    if about is None:
        about = match_entries(lists, at(issue_s), scene, unknown_origins(lists), gate_m=3.0)
    frames = make_held_frames(np.array(frame_s), given_episodes, at, lambda _: reference)
    errors = HeldErrors(
        frames, np.array(issue_s, dtype=float), max_age_s, scene, given_episodes, classes("car"),
        settings=AccuracySettings(cutoff_m=3.0, gate_m=3.0), runs=len(runs),
    )  # fmt: skip
    errors.add(lists, about)
    return errors.result()


def nan_as_none(row: Any) -> list[float | None]:
    return [None if math.isnan(value) else round(float(value), 4) for value in row]


def test_what_is_held_falls_behind_until_the_next_list() -> None:
    """A car at 10 m/s, listed at 0 s where it is and at 0.3 s where it was 0.1 s ago."""
    frame_s = [0.0, 0.1, 0.2, 0.3, 0.4]
    found = measured(
        [entry(20, captured_s=0.0), entry(22, captured_s=0.2)], issue_s=[0.0, 0.3], frame_s=frame_s,
        places={CAR: [(20 + 10 * t, 0.0) for t in frame_s]}, episodes={CAR: (0.0, 1.0)},
    )  # fmt: skip
    assert nan_as_none(found.error_m[0]) == [0.0, 1.0, 2.0, 1.0, 2.0]
    assert nan_as_none(found.age_s[0]) == [0.0, 0.1, 0.2, 0.1, 0.2]
    assert nan_as_none(found.gospa[0]) == [0.0, 1.0, 4.0, 1.0, 4.0]
    assert found.list_ix.tolist() == [0, 0, 0, 1, 1]


def test_an_entry_keeps_its_object_though_another_is_nearer_now() -> None:
    """Two cars in a row, 2 m apart, at 20 m/s: 0.1 s later the rear one is where the front one was listed."""
    ways: Places = {CAR: [(10.0, 0.0), (12.0, 0.0)], OTHER_CAR: [(12.0, 0.0), (14.0, 0.0)]}
    found = measured(
        [one_list(entry(10), entry(12))], issue_s=[0.0], frame_s=[0.0, 0.1], places=ways,
        episodes={CAR: (0.0, 1.0), OTHER_CAR: (0.0, 1.0)},
    )  # fmt: skip
    assert nan_as_none(found.error_m[0]) == [0.0, 2.0, 0.0, 2.0]
    # GOSPA pairs anew: 0 m and a pair that is too far apart, 9 m², is worse than twice 2 m.
    assert nan_as_none(found.gospa[0]) == [0.0, 4.0, 0.0, 4.0]


def test_a_list_that_is_too_old_is_empty_and_one_that_was_never_issued_too() -> None:
    frame_s = [0.0, 1.0, 2.0, 3.0]
    found = measured(
        [entry(20)], issue_s=[1.0], frame_s=frame_s, places={CAR: [(20.0, 0.0)] * 4}, episodes={CAR: (0.0, 3.0)},
    )  # fmt: skip
    assert found.list_ix.tolist() == [-1, 0, 0, -1]
    assert nan_as_none(found.error_m[0]) == [None, 0.0, 0.0, None]
    assert nan_as_none(found.gospa[0]) == [4.5, 0.0, 0.0, 4.5]


def test_an_entry_whose_object_has_left_is_counted_and_in_no_error() -> None:
    """The other car stays: the entry about the one that left is false, and belongs to the nearest."""
    found = measured(
        [one_list(entry(10), entry(20))], issue_s=[0.0], frame_s=[0.0, 0.5],
        places={CAR: [(10.0, 0.0), None], OTHER_CAR: [(20.0, 0.0), (20.0, 0.0)]},
        episodes={CAR: (0.0, 0.0), OTHER_CAR: (0.0, 1.0)},
    )  # fmt: skip
    assert found.without_truth.tolist() == [1]
    assert nan_as_none(found.error_m[0]) == [0.0, 0.0, 0.0]  # the first car has one frame
    assert nan_as_none(found.gospa[0]) == [0.0, 0.0, 4.5]


def test_before_its_onset_an_object_is_in_nothing() -> None:
    found = measured(
        [entry(13)], issue_s=[0.0], frame_s=[0.0, 0.5, 1.0], places={CAR: [(10.0, 0.0), None, (12.0, 0.0)]},
        episodes={CAR: (0.75, 2.0)},
    )  # fmt: skip
    assert (found.first.tolist(), found.count.tolist()) == ([2], [1])
    assert nan_as_none(found.error_m[0]) == [1.0]
    assert found.without_truth.tolist() == [0]


# Random scenes against plain loops, and in chunks.


class HeldScenery(Scenery):
    """The same with frames of a truth of their own."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        rng, self.max_age_s = self.rng, float(self.rng.choice([0.1, 0.3, 1.0]))
        self.frame_s = np.cumsum(rng.uniform(0.1, 0.3, int(rng.integers(0, 9))))
        ways = {o: [rng.uniform(-6, 6, 2) for _ in self.frame_s] for o in self.places}
        self.at_frames: dict[int, list[tuple[float, float] | None]] = {
            o: [(float(x), float(y)) if rng.uniform() < 0.8 else None for x, y in way] for o, way in ways.items()
        }
        self.reference_at_frames: Reference = reference_of(
            [None if rng.uniform() < 0.15 else (float(x), 0.0) for x in rng.normal(0, 1, len(self.frame_s))]
        )

    def held(self, cuts: Sequence[float] = ()) -> HeldAccuracy:
        where = {round(t, 9): k for k, t in enumerate(self.frame_s.tolist())}

        def at(time_s: Any) -> Tracks:
            k = [where[round(t, 9)] for t in time_s.tolist()]
            return truth_of({o: [way[f] for f in k] for o, way in self.at_frames.items()}, time_s)

        frames = make_held_frames(self.frame_s, self.episodes, at, lambda _: self.reference_at_frames)
        errors = HeldErrors(
            frames, self.times, self.max_age_s, self.scene, self.episodes, self.measured, settings=self.settings,
            runs=len(self.lists.start),
        )  # fmt: skip
        for a, b in chunks(cuts, len(self.times)):
            lists, rows = between(self.lists, a, b)
            errors.add(lists, taken(self.found[0], rows))
        return errors.result()


@given(st.integers(0, 2**32 - 1))
def test_what_is_held_is_as_the_sentences_have_it(seed: int) -> None:
    made = HeldScenery(seed)
    found = made.held()
    *expected, gone = held_plainly(
        made.lists, made.found[0], made.times, made.frame_s, made.at_frames, made.episodes, made.reference_at_frames,
        made.measured, made.settings, made.max_age_s,
    )  # fmt: skip
    assert found.without_truth.tolist() == gone
    for columns, values in zip((found.error_m, found.age_s, found.gospa), expected, strict=True):
        got, column = {}, 0
        for m, (first, count) in enumerate(zip(found.first.tolist(), found.count.tolist(), strict=True)):
            for g in range(first, first + count):
                got |= {(s, m, g): float(row[column]) for s, row in enumerate(columns) if not math.isnan(row[column])}
                column += 1
        assert column == columns.shape[1]
        assert got == pytest.approx(values, rel=1e-4, abs=1e-5)


@given(st.integers(0, 2**32 - 1), st.lists(st.floats(0, 1), max_size=6))
def test_chunks_hold_what_the_whole_holds_to_the_last_bit(seed: int, cuts: list[float]) -> None:
    made = HeldScenery(seed)
    whole, cut = made.held(), made.held(cuts)
    for name, column in vars(whole).items():
        np.testing.assert_array_equal(getattr(cut, name), column, err_msg=name)


def test_frames_that_are_left_over_are_a_defect() -> None:
    made = HeldScenery(3)
    made.frame_s, made.times = np.array([0.5]), np.array([0.1])
    made.at_frames = {o: [(0.0, 0.0)] for o in made.places}
    made.reference_at_frames = reference_of([(0.0, 0.0)])
    frames = make_held_frames(
        made.frame_s, made.episodes, lambda t: truth_of(made.at_frames, t), lambda _: made.reference_at_frames
    )
    errors = HeldErrors(
        frames, made.times, 1.0, made.scene, made.episodes, made.measured, settings=made.settings, runs=1
    )
    with pytest.raises(ValueError, match="expected 1 frames, found 0"):
        errors.result()
    errors.add(lists_of([[one_list()]]), matches_of([], []))
    assert errors.result().list_ix.tolist() == [0]


# Configurations that are late, against the ideal of the same units.

NOISY = [{"detection": {"kind": "constant", "probability": 1.0},
          "error": {"kind": "gaussian", "covariance_m2": [[0.04, 0.0], [0.0, 0.04]]}}]  # fmt: skip


def compared(path: Path, things: Sequence[Thing], configurations: dict[str, Any], **more: Any) -> Comparison:
    """A standing ego that lists everything at 10 Hz for 10 s, in 20 runs."""
    path.mkdir()
    (path / "scene.mcap").write_bytes(b"what the provenance has a digest of")
    log = recording([Thing("ego", "car", standing(0, 0)), *things], until_s=10.0)
    plan = experiment(
        pems={"sure": NOISY}, units={"ego": EGO_UNIT}, runs=20, configurations=configurations,
        measure={"onset": {"kind": "appears"}, "match": {"gate_m": 3.0}}, **more,
    )  # fmt: skip
    recordings = [replace(log, path=path / "scene.mcap")]
    save_run(path / "out", plan, recordings, replays=False)
    return compare_folders([path / "out"], baseline="ideal")


def error_of(comparison: Comparison, name: str) -> Any:
    return comparison.overall.set_index(["configuration", "metric"]).loc[(name, "position_rmse_held_m")]


@pytest.mark.parametrize("speed_mps", [2.0, 8.0, 15.0])
def test_half_a_second_late_is_off_by_speed_times_age(tmp_path: Path, speed_mps: float) -> None:
    """Two cars beside each other: √(RMSE² − ideal²) = v · mean age; the gnn issues 7 times a second."""
    things = [Thing(f"c{k}", "car", driving(20, 10 * k, speed_mps)) for k in range(2)]
    late = {"units": ["ego"], "latency_s": 0.5}
    comparison = compared(
        tmp_path / "a", things,
        {
            "ideal": {"units": ["ego"]}, "late": late,
            "late:gnn": late | {"fusion": {"kind": "gnn"}, "issue_hz": 7.0},
        },
    )  # fmt: skip
    for name in ("late", "late:gnn"):
        row = error_of(comparison, name)
        off_m = math.sqrt(row["value"] ** 2 - row["baseline_value"] ** 2)
        assert off_m == pytest.approx(speed_mps * row["age_s"], rel=0.03)
        assert 0.5 - 1e-3 <= row["age_s"] <= 0.68
        assert row["baseline_age_s"] == pytest.approx(0.0, abs=1e-3)
        assert (row["only_configuration"], row["only_baseline"]) == (0, 0)
        # From the first list, 0.5 s late or at the next of 7 a second, to 10 s: 96 or 95 frames.
        assert row["frames"] == 20 * (96 if name == "late" else 95)
        assert row["n"] == 2 * row["frames"]


def test_of_what_stands_nothing_is_lost(tmp_path: Path) -> None:
    things = [Thing(f"c{k}", "car", standing(20, 10 * k)) for k in range(4)]
    configurations = {"ideal": {"units": ["ego"]}, "late": {"units": ["ego"], "latency_s": 0.5}}
    row = error_of(
        compared(
            tmp_path / "a",
            things,
            configurations,
        ),
        "late",
    )
    assert row["value"] == pytest.approx(math.sqrt(2 * 0.04), rel=0.03)
    assert abs(row["difference"]) <= 0.01


def test_a_receiver_that_issues_rarely_has_no_list_between(tmp_path: Path) -> None:
    """Once in two seconds, held for 0.55 s: at 0 to 0.5 s of every two there is a list, 6 frames of 20."""
    things = [Thing("c", "car", driving(20, 0, 1))]
    rare = {"units": ["ego"], "fusion": {"kind": "gnn"}, "issue_hz": 0.5, "max_age_s": 0.55}
    comparison = compared(tmp_path / "a", things, {"ideal": {"units": ["ego"]}, "rare": rare})
    row = error_of(comparison, "rare")
    assert row["frames"] == 20 * 101
    assert row["no_list_share"] == pytest.approx(1 - (5 * 6 + 1) / 101)
    assert row["only_baseline"] == row["frames"] - row["n"] == 20 * 70
    gospa = comparison.overall.set_index(["configuration", "metric"]).loc[("rare", "gospa_held_m")]
    # Of 3 m and power 2 a miss is 4.5 m².
    assert gospa["value"] == pytest.approx(
        math.sqrt(4.5 * row["no_list_share"] + 31 / 101 * row["value"] ** 2), rel=1e-3
    )
    assert pd.isna(row["p_value"])
