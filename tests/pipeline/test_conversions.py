"""Lists without truth: when the receiver has which, what is in them, and back to tracks again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.communication.arrivals import FusionSchedule, find_out_of_sequence, fusion_schedule
from copem_replay.core.object_list import ENTRY, Entries, ObjectLists, entries_of
from copem_replay.core.tracks import CLASSES, VALUES, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.inputs import make_inputs
from copem_replay.fusion.interface import make_inbox
from copem_replay.io.recording import Recording
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, match_entries
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.receiver import convert_to_tracks, remove_truth_ids
from tests.helpers.replays import outputs_of, world_of
from tests.helpers.reports import inputs_of, lists_of
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

Sent = Sequence[tuple[str, float, float]]
"""Lists: whose, captured, arrives."""


def lists_alone(sent: Sent, units: Sequence[str]) -> Tracks:
    """Lists with nothing in them."""
    none, nothing = np.empty(0, dtype=np.int64), np.empty((1, 0))
    captured_s = np.array([captured for _, captured, _ in sent], dtype=float)
    return Tracks(
        tuple(units), np.zeros(1, dtype=np.int64), none, none, none, np.rint(captured_s * 1e9).astype(np.int64),
        captured_s, np.array([units.index(unit) for unit, _, _ in sent], dtype=np.int64),
        np.array([[arrives for _, _, arrives in sent]], dtype=float), nothing.astype(bool),
        **dict.fromkeys(VALUES, nothing),
    )  # fmt: skip


def received(sent: Sent, units: Sequence[str] = ("a", "b"), max_age_s: float = 1.0) -> FusionSchedule:
    return fusion_schedule(lists_alone(sent, units), max_age_s=max_age_s)


def arrived(at: FusionSchedule) -> list[list[int]]:
    return [
        at.arrived[first:last].tolist() for first, last in zip(at.arrived_start, at.arrived_start[1:], strict=False)
    ]


class TestInstants:
    def test_a_list_outrun_by_a_newer_one_arrives_but_is_not_gone_by(self) -> None:
        sent = [("a", 0.0, 0.3), ("a", 0.1, 0.5), ("a", 0.2, 0.4), ("a", 0.3, 0.6)]
        at = received(sent)
        np.testing.assert_allclose(at.issue_s, [0.3, 0.4, 0.5, 0.6])
        assert at.newest.tolist() == [[0, -1], [2, -1], [2, -1], [3, -1]]
        assert arrived(at) == [[0], [2], [1], [3]]
        assert find_out_of_sequence(lists_alone(sent, ("a", "b"))).tolist() == [False, True, False, False]

    def test_of_lists_that_arrive_together_the_newest_counts(self) -> None:
        at = received([("a", 0.0, 0.5), ("a", 0.2, 0.5), ("a", 0.1, 0.5), ("b", 0.1, 0.5)])
        assert at.newest.tolist() == [[1, 3]]
        assert arrived(at) == [[0, 1, 2, 3]]

    def test_a_unit_is_not_outrun_by_another(self) -> None:
        at = received([("a", 0.0, 0.5), ("b", 0.3, 0.4)])
        assert at.newest.tolist() == [[-1, 1], [0, 1]]

    def test_a_list_is_used_until_it_is_too_old_beyond_its_way(self) -> None:
        """Captured at 0 and 0.2 s under way, at most 0.5 s old: until 0.7 s, the bound included."""
        sent = [("a", 0.0, 0.2), *(("b", k / 10, k / 10) for k in range(3, 10))]
        at = received(sent, max_age_s=0.5)
        assert at.newest[:, 0].tolist() == [0, 0, 0, 0, 0, 0, -1, -1]
        np.testing.assert_allclose(at.issue_s, np.arange(2, 10) / 10)

    def test_what_is_too_old_is_not_replaced_by_what_is_older(self) -> None:
        at = received([("a", 0.1, 0.1), ("a", 0.0, 0.8), ("b", 0.9, 0.9)], max_age_s=0.5)
        assert at.newest.tolist() == [[0, -1], [-1, -1], [-1, 2]]

    def test_within_a_microsecond_is_one_instant(self) -> None:
        at = received([("a", 0.0, 1.0), ("b", 0.0, 1.0 + 0.9e-6), ("a", 0.5, 2.0), ("b", 0.5, 2.0 + 1.2e-6)])
        assert at.newest.tolist() == [[0, 1], [2, 1], [2, 3]]
        np.testing.assert_allclose(at.issue_s, [1.0 + 0.9e-6, 2.0, 2.0 + 1.2e-6], atol=1e-9)

    def test_what_never_arrives(self) -> None:
        at = received([("a", 0.0, np.inf), ("b", 0.1, 0.2), ("b", 0.0, np.inf)])
        assert at.newest.tolist() == [[-1, 1]]
        assert arrived(at) == [[1]]

    @pytest.mark.parametrize("sent", [[], [("a", 0.0, np.inf)]])
    def test_no_instants(self, sent: Sent) -> None:
        at = received(sent)
        assert (len(at.issue_s), len(at.arrived), at.newest.shape) == (0, 0, (0, 2))

    @given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 12), st.integers(0, 9)), min_size=1), st.data())
    def test_as_the_words_say(self, drawn: list[tuple[str, int, int]], data: st.DataObject) -> None:
        """Against lists of Python; the last of ten delays is never."""
        sent = [(u, c / 10, (c + late) / 10 if late < 9 else np.inf) for u, c, late in drawn]
        max_age_s = data.draw(st.sampled_from([0.15, 0.4, 2.0]))
        at = received(sent, "abc", max_age_s)
        whose, captured_s, arrives_s = zip(*sent, strict=True)
        expected = inputs_of([[entries_of(0)] * len(sent)], whose, captured_s, arrives_s, max_age_s, "abc")
        np.testing.assert_allclose(at.issue_s, expected.issue_s)
        assert at.newest.tolist() == expected.newest.tolist()
        assert arrived(at) == [
            expected.arrived[first:last].tolist()
            for first, last in zip(expected.arrived_start, expected.arrived_start[1:], strict=False)
        ]

    def test_the_inbox_is_in_order_of_capture_and_ones_own(self) -> None:
        sent = [("a", 0.2, 0.5), ("b", 0.1, 0.5), ("a", 0.0, 0.5), ("b", 0.3, 0.6), ("b", 0.2, 0.7)]
        told = make_inputs(lists_alone(sent, ("a", "b")), lists_of([[entries_of(1)] * 5]), max_age_s=1.0)
        inbox = make_inbox(told, 0, 0)
        assert [(one.unit, one.captured_s) for one in inbox.newest] == [("a", 0.2), ("b", 0.1)]
        assert [(one.unit, one.captured_s) for one in inbox.arrived] == [("a", 0.0), ("b", 0.1), ("a", 0.2)]
        late = make_inbox(told, 0, 2)
        assert [(one.unit, one.captured_s, one.arrives_s) for one in late.arrived] == [("b", 0.2, 0.7)]
        assert [one.captured_s for one in late.newest] == [0.2, 0.3]
        inbox.newest[0].entries["x_m"] = 9.0
        assert make_inbox(told, 0, 0).newest[0].entries["x_m"].tolist() == [0.0]


NAMES = ("ego", "other", "walker", "lorry", "second")


def crowd(names: Sequence[str] = NAMES, order: Sequence[int] = range(5)) -> Recording:
    """The ego and four others, 1 s; all differ in class or place. `order`: in which the log has them."""
    ego, *others = names
    things = [
        Thing(ego, "car", driving(0, 0, 5)), Thing(others[0], "car", driving(40, 8, -5), yaw_rad=np.pi),
        Thing(others[1], "pedestrian", driving(20, 6, 0, 1)), Thing(others[2], "truck", driving(30, -9, 8)),
        Thing(others[3], "pedestrian", standing(25, 12)),
    ]  # fmt: skip
    return recording([things[k] for k in order], until_s=1.0, ego=ego)


TWO_UNITS = {"ego": EGO_UNIT | {"pem": "p"}, "v2v": {"on": "other", "height_m": 1.8, "pem": "p"}}


def pem(covariance_m2: Any = None, **more: Any) -> dict[str, Any]:
    error = {} if covariance_m2 is None else {"error": {"kind": "gaussian", "covariance_m2": covariance_m2}}
    return {"p": [{"detection": {"kind": "constant", "probability": more.pop("probability", 1.0)}, **error, **more}]}


def told_in(plan: Experiment, log: Recording, runs: Sequence[int] = (0,)) -> tuple[Tracks, ObjectLists]:
    """What the units list with truth ids, and without."""
    world = world_of(prepare_log(log, plan), plan, runs)
    return world.sent("sampled"), remove_truth_ids(world)[0]


def as_sets(lists: ObjectLists, run: int = 0) -> list[Counter[bytes]]:
    return [Counter(e.tobytes() for e in lists.of(run, k)) for k in range(lists.start.shape[1] - 1)]


class TestWithoutTruth:
    def test_nothing_in_an_entry_goes_by_who_it_is(self) -> None:
        """Other names, and other numbers: the same entries to the last bit. All that a unit says is exact here."""
        plan = experiment(pems=pem(), units=TWO_UNITS)
        for other in (crowd(("me", "other", "x", "17", "second")), crowd(order=(3, 1, 4, 0, 2))):
            assert as_sets(told_in(plan, other)[1]) == as_sets(told_in(plan, crowd())[1])

    def test_what_an_entry_says(self) -> None:
        plan = experiment(pems=pem([[2.0, 0.5], [0.5, 1.0]], existence=0.7), units=TWO_UNITS)
        seen, lists = told_in(plan, crowd())
        for f in range(len(seen.stamp_ns)):
            for entry in lists.of(0, f):
                (row,) = np.flatnonzero((seen.frame_ix == f) & (seen.x_m[0] == entry["x_m"]))
                assert all(entry[name] == getattr(seen, name)[0, row] for name in VALUES)
                cov = [entry[name] for name in ("cov_ee_m2", "cov_en_m2", "cov_nn_m2")]
                np.testing.assert_allclose(cov, [2.0, 0.5, 1.0])
                kind = crowd().scene.object_class[seen.row_object_ix[row]]
                assert entry["class_probability"].tolist() == np.eye(len(CLASSES))[kind].tolist()
                assert (entry["existence"], entry["track_id"]) == (0.7, -1)
                assert (entry["captured_s"], entry["unit_ix"]) == (seen.captured_s[f], seen.frame_unit_ix[f])

    def test_the_receivers_own_body_is_left_out_and_nothing_else(self) -> None:
        seen, lists = told_in(experiment(pems=pem(probability=0.6), units=TWO_UNITS), crowd(), range(5))
        assert (seen.valid & (seen.row_object_ix == 0)).any(), "the other car sees the ego"
        for s in range(5):
            kept = seen.valid[s] & (seen.row_object_ix != 0)
            expected = np.bincount(seen.frame_ix[kept], minlength=len(seen.stamp_ns))
            assert np.diff(lists.start[s]).tolist() == expected.tolist()
            assert sorted(lists.entries["x_m"][lists.start[s, 0] : lists.start[s, -1]]) == sorted(seen.x_m[0, kept])

    def test_a_run_says_the_same_alone_and_among_others(self) -> None:
        plan = experiment(pems=pem([[1, 0], [0, 1]], probability=0.7), units=TWO_UNITS)
        _, batch = told_in(plan, crowd(), range(6))
        for s in (0, 3, 5):
            _, alone = told_in(plan, crowd(), [s])
            assert np.diff(batch.start[s]).tolist() == np.diff(alone.start[0]).tolist()
            assert batch.entries[batch.start[s, 0] : batch.start[s, -1]].tobytes() == alone.entries.tobytes()

    def test_the_order_within_a_list_is_drawn(self) -> None:
        """Of the four things that the ego lists each comes first in about a quarter of 60 runs × 11 lists."""
        _, lists = told_in(experiment(pems=pem(), units={"ego": EGO_UNIT | {"pem": "p"}}), crowd(), range(60))
        assert len({lists.of(s, 3)["y_m"].tobytes() for s in range(60)}) > 15, "of 24 orders"
        lengths = [float(lists.of(s, f)["length_m"][0]) for s in range(60) for f in range(11)]
        shares = {length: lengths.count(length) / 660 for length in set(lengths)}
        # 5 standard deviations: √(0.25 · 0.75 / 660) = 0.017. Two of the four are pedestrians.
        assert shares[4.0] == pytest.approx(0.25, abs=0.085)
        assert shares[8.0] == pytest.approx(0.25, abs=0.085)
        assert shares[0.5] == pytest.approx(0.5, abs=0.1)

    @pytest.mark.parametrize("covariance_m2", [None, [[0, 0], [0, 0]], [[1, 1], [1, 1]], [[4, 0], [0, 0]]])
    def test_covariances_have_a_floor(self, covariance_m2: Any) -> None:
        _, lists = told_in(experiment(pems=pem(covariance_m2), units=TWO_UNITS), crowd())
        e = lists.entries
        found = np.linalg.eigvalsh(np.array([[e["cov_ee_m2"], e["cov_en_m2"]], [e["cov_en_m2"], e["cov_nn_m2"]]]).T)
        given = np.linalg.eigvalsh(np.array(covariance_m2 or [[0, 0], [0, 0]], dtype=float))
        np.testing.assert_allclose(found, np.tile(np.maximum(given, 1e-9), (len(e), 1)), rtol=1e-6, atol=1e-15)


def entries_in(lists: ObjectLists, run: int) -> Entries:
    part: Entries = lists.entries[lists.start[run, 0] : lists.start[run, -1]]
    return part


class TestBackToTracks:
    """The other car sees what the ego sees, 0.8 s later: what moves is a ghost then, what stands a duplicate."""

    def configurations(self) -> dict[str, Any]:
        common = {"units": "all", "latency_s": {"v2v": 0.8}}
        return {kind: common | {"fusion": {"kind": kind}} for kind in ("ideal", "union", "gnn", "tracker")}

    def test_nothing_is_lost_and_everyone_is_where_he_belongs(self) -> None:
        pems = pem([[0.1, 0], [0, 0.1]], probability=0.8)
        plan = experiment(pems=pems, units=TWO_UNITS, configurations=self.configurations())
        replay = prepare_log(crowd(), plan)
        roles: Counter[int] = Counter()
        for name, told in outputs_of(replay, plan, np.arange(3)).items():
            issue_s = told.instants.issue_s
            matches = match_entries(told.lists, replay.truth_cache.at(issue_s), replay.scene, told.origins, gate_m=3.0)
            for s in range(3):
                fused_tracks = convert_to_tracks(told, s, matches)
                fused, said = fused_tracks.fused, fused_tracks.said
                assert said is not None
                assert Counter(map(bytes, said)) == Counter(map(bytes, entries_in(told.lists, s))), name
                assert np.array_equal(fused_tracks.captured_s[0], said["captured_s"])
                assert all(np.array_equal(getattr(fused, value)[0], said[value]) for value in VALUES)
                assert np.bincount(fused.object_ix + 1)[1:].max() == 1, "one track of an object"
                order, bounds = fused.by_frame
                for k in range(len(issue_s)):
                    here = slice(told.lists.start[s, k], told.lists.start[s, k + 1])
                    rows = order[bounds[k] : bounds[k + 1]]
                    listed = dict(zip(map(bytes, said[rows]), fused.row_object_ix[rows].tolist(), strict=True))
                    about = np.where(matches.role[here] == MATCH, matches.object_ix[here], -1).tolist()
                    assert listed == dict(zip(map(bytes, told.lists.entries[here]), about, strict=True))
                    roles.update(matches.role[here].tolist())
        assert min(roles[role] for role in (MATCH, DUPLICATE, GHOST)) > 0, "there is something to lose"

    def test_who_is_nobodys_match_keeps_the_fusions_own_identity(self) -> None:
        """With a gate of nothing all are ghosts: a track of each of the tracker's tracks, of each entry of union."""
        plan = experiment(pems=pem([[1, 0], [0, 1]]), units=TWO_UNITS, configurations=self.configurations())
        replay = prepare_log(crowd(), plan)
        for name, told in outputs_of(replay, plan).items():
            matches = match_entries(
                told.lists, replay.truth_cache.at(told.instants.issue_s), replay.scene, told.origins, gate_m=1e-6
            )
            fused_tracks = convert_to_tracks(told, 0, matches)
            assert set(fused_tracks.fused.object_ix) == {-1}
            ids = entries_in(told.lists, 0)["track_id"]
            assert len(fused_tracks.fused.object_ix) == (len(set(ids)) if name == "tracker" else len(ids))
            assert len(np.unique(fused_tracks.fused.frame_ix)) > 5

    def test_ideal_fusion_is_as_sure_of_its_list_as_it_is(self) -> None:
        log = crowd()
        plan = experiment(pems=pem(probability=0.5), units=TWO_UNITS, configurations=self.configurations())
        told = outputs_of(prepare_log(log, plan), plan, np.arange(2))["ideal"]
        fused_tracks, lists = told.fused_tracks, told.lists
        assert fused_tracks is not None
        assert lists.entries.dtype == ENTRY
        assert set(lists.entries["existence"]) == {1.0}
        assert set(lists.entries["track_id"]) == {-1}
        for s in range(2):
            entries, rows = entries_in(lists, s), np.flatnonzero(fused_tracks.fused.valid[s])
            rows = rows[np.argsort(fused_tracks.fused.frame_ix[rows], kind="stable")]
            assert entries["x_m"].tolist() == fused_tracks.fused.x_m[s, rows].tolist()
            assert entries["captured_s"].tolist() == fused_tracks.captured_s[s, rows].tolist()
            assert entries["unit_ix"].tolist() == fused_tracks.first_unit_ix[s, rows].tolist()
            kinds = log.scene.object_class[fused_tracks.fused.row_object_ix[rows]]
            assert entries["class_probability"].argmax(axis=1).tolist() == kinds.tolist()


def test_a_belief_of_a_run_without_entries_is_empty() -> None:
    union = {"u": {"units": "all", "fusion": {"kind": "union"}}}
    plan = experiment(pems=pem(probability=0.0), configurations=union, units=TWO_UNITS)
    replay = prepare_log(crowd(), plan)
    [told] = outputs_of(replay, plan).values()
    matches = match_entries(
        told.lists, replay.truth_cache.at(told.instants.issue_s), replay.scene, told.origins, gate_m=3.0
    )
    fused_tracks = convert_to_tracks(told, 0, matches)
    assert (len(fused_tracks.fused.frame_ix), len(fused_tracks.fused.object_ix)) == (0, 0)
    assert len(fused_tracks.fused.stamp_ns) == 11, "its lists are there, and empty"
