"""Non-maximum suppression by hand, and against plain loops over Shapely's polygons."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from copem_replay.core.object_list import Entries, Inputs, entries_of
from copem_replay.core.tracks import CLASS_GROUPS, CLASSES
from copem_replay.fusion.nms import Nms
from tests.helpers.reports import entry, inputs_of, joined
from tests.oracles.gnn import in_any_order, random_reports

BIG = (2.0, 0.0, 2.0)


def kept(component: Nms, *lists: Entries) -> list[float]:
    """The x of what is kept of lists of as many units, captured together."""
    names = [f"unit {k}" for k in range(len(lists))]
    times = [0.0] * len(lists)
    return sorted(component.fuse(inputs_of([lists], names, times, times)).entries["x_m"].tolist())


# ------------------------------------------------------------------------- by hand


def test_of_two_boxes_of_one_object_the_more_certain_is_kept_unchanged():
    # 4 m × 2 m, a metre apart lengthwise: 6 of 10 square metres in common.
    lists = [entry(0.0, existence=0.7, track_id=3), entry(1.0, existence=0.8, vx_mps=2.0, cov=BIG, track_id=4)]
    fused = Nms().fuse(inputs_of([lists], ["a", "b"], [0.2, 0.1], [0.2, 0.2]))
    expected = lists[1].copy()
    expected["captured_s"], expected["unit_ix"], expected["track_id"] = 0.1, 1, -1
    assert fused.start.tolist() == [[0, 1]]
    assert in_any_order(fused.entries) == in_any_order(expected)


@pytest.mark.parametrize(("iou", "expected"), [(0.59, [0.0]), (0.61, [0.0, 1.0])])
def test_boxes_may_have_the_threshold_in_common(iou: float, expected: list[float]):
    assert kept(Nms(iou=iou), entry(0.0, existence=0.9), entry(1.0, existence=0.8)) == expected


def test_boxes_turn_with_yaw():
    # Side by side 3 m apart: apart as they stand, by a quarter turn of both they overlap by a metre of seven.
    for yaw_rad, expected in ((math.pi / 2, [0.0, 3.0]), (0.0, [0.0])):
        lists = [entry(0.0, yaw_rad=yaw_rad), entry(3.0, existence=0.9, yaw_rad=yaw_rad)]
        assert kept(Nms(iou=0.14), *lists) == expected


def test_what_is_suppressed_suppresses_nothing():
    # 0 takes out 1.5, which alone would take out 3.
    lists = [entry(0.0, existence=0.9), entry(1.5, existence=0.8), entry(3.0, existence=0.7)]
    assert kept(Nms(iou=0.2), *lists) == [0.0, 3.0]


def test_one_unit_may_suppress_itself():
    assert kept(Nms(), joined(entry(0.0, existence=0.8), entry(0.5, existence=0.9))) == [0.5]


def test_of_equally_likely_ones_the_smaller_covariance_is_kept():
    assert kept(Nms(), entry(0.0), entry(0.5, cov=(1.0, 0.0, 0.9)), entry(1.0, cov=BIG)) == [0.5]


def test_then_the_newer_capture_then_the_place():
    newer = Nms().fuse(inputs_of([[entry(0.0), entry(1.0)]], ["a", "b"], [0.0, 0.1], [0.2, 0.2]))
    assert newer.entries["x_m"].tolist() == [1.0]
    assert kept(Nms(), entry(1.0), entry(0.5)) == [0.5]
    fused = Nms().fuse(inputs_of([[entry(0.0, 1.0), entry(0.0, 0.5)]], ["a", "b"], [0.0] * 2, [0.0] * 2))
    assert fused.entries["y_m"].tolist() == [0.5]


def test_of_the_very_same_entry_it_is_the_unit_that_came_first():
    for arrives_s, first in (([0.2, 0.1], 1), ([0.1, 0.2], 0), ([0.2, 0.2], 0)):
        fused = Nms().fuse(inputs_of([[entry(0.0)] * 2], ["a", "b"], [0.0, 0.0], arrives_s, names=["a", "b"]))
        assert fused.of(0, len(fused.start[0]) - 2)["unit_ix"].tolist() == [first]


@pytest.mark.parametrize(
    ("classes", "count"),
    [
        (("car", "car"), 1),
        (("car", "pedestrian"), 2),
        (("car", "truck"), 2),
        (("vehicle", "truck"), 1),
        (("pedestrian", "vehicle"), 2),
        (("other", "pedestrian"), 1),
        (("other", "vehicle"), 1),
    ],
)
def test_only_classes_that_agree_suppress(classes: tuple[str, str], count: int):
    first, second = classes
    assert len(kept(Nms(), entry(0.0, of=first), entry(0.5, of=second))) == count


@pytest.mark.parametrize(("x_m", "expected"), [(2.0, [0.0]), (2.01, [0.0, 2.01])])
def test_by_centre_only_the_distance_counts(x_m: float, expected: list[float]):
    point = {"length_m": 0.0, "width_m": 0.0, "existence": 0.5}
    assert kept(Nms(by="centre"), entry(0.0), entry(x_m, **point)) == expected
    assert kept(Nms(by="centre", radius_m=0.1), entry(0.0), entry(x_m, **point)) == [0.0, x_m]


def test_what_has_no_size_overlaps_nothing():
    assert kept(Nms(iou=0.0), entry(0.0), entry(0.0, existence=0.5, length_m=0.0)) == [0.0, 0.0]


def test_less_likely_entries_neither_stay_nor_suppress():
    assert kept(Nms(), entry(0.0, existence=0.2), entry(10.0, existence=0.19)) == [0.0]
    assert kept(Nms(min_existence=0.5), entry(0.0, existence=0.49)) == []


@pytest.mark.parametrize("named", ["car", "pedestrian"])
def test_nothing_said_of_the_class_agrees_with_all(named: str):
    silent = entry(0.0, class_probability=np.zeros(len(CLASSES)))
    assert kept(Nms(), entry(0.5, of=named, existence=0.5), silent) == [0.0]


def test_a_list_that_is_too_old_suppresses_no_more():
    # The certain one is at the receiver for 1 s.
    lists = [entry(0.0), entry(0.5, existence=0.5), entry(0.6, existence=0.5)]
    fused = Nms().fuse(inputs_of([lists], ["a", "b", "b"], [0.0, 0.9, 1.1], [0.0, 0.9, 1.1]))
    assert [fused.of(0, k)["x_m"].tolist() for k in range(3)] == [[0.0], [0.0], [0.6]]


def test_lists_without_entries_and_no_lists_at_all():
    fused = Nms().fuse(inputs_of([[entries_of(0), entries_of(0)]] * 2, ["a", "b"], [0.0, 0.1], [0.0, 0.1]))
    assert fused.start.tolist() == [[0, 0, 0]] * 2
    never = Nms().fuse(inputs_of([[entry(0.0)]], ["a"], [0.0], [np.inf]))
    assert never.start.tolist() == [[0]]
    assert len(Nms().fuse(inputs_of([[]], [], [], [], names=["a"])).entries) == 0


@pytest.mark.parametrize("wrong", [{"iou": 1.1}, {"radius_m": 0.0}, {"min_existence": -0.1}, {"by": "area"}])
def test_what_is_no_threshold_is_refused(wrong: dict[str, object]):
    with pytest.raises(ValidationError):
        Nms(**wrong)


# ------------------------------------------------------------------------- against plain loops


def polygon(one: Entries) -> shapely.Polygon:
    box = shapely.box(-one["length_m"] / 2, -one["width_m"] / 2, one["length_m"] / 2, one["width_m"] / 2)
    turned = shapely.affinity.rotate(box, float(one["yaw_rad"]), origin=(0, 0), use_radians=True)
    return shapely.affinity.translate(turned, one["x_m"], one["y_m"])


def agree(a: Entries, b: Entries) -> bool:
    names = {CLASSES[a["class_probability"].argmax()], CLASSES[b["class_probability"].argmax()]}
    return len(names) == 1 or "other" in names or ("vehicle" in names and names <= {*CLASS_GROUPS["vehicles"]})


def plainly(component: Nms, entries: Entries) -> list[Entries]:
    """Of all entries of all newest lists, in plain loops."""
    left = [one for one in entries if one["existence"] >= component.min_existence]
    left.sort(key=lambda a: (-a["existence"], a["cov_ee_m2"] + a["cov_nn_m2"], -a["captured_s"], a["x_m"], a["y_m"]))
    chosen: list[Entries] = []
    for one in left:
        for other in chosen:
            if not agree(one, other):
                continue
            if component.by == "centre":
                overlap = math.dist((one["x_m"], one["y_m"]), (other["x_m"], other["y_m"])) <= component.radius_m
            else:
                a, b = polygon(one), polygon(other)
                overlap = a.intersection(b).area / a.union(b).area > component.iou
            if overlap:
                break
        else:
            chosen.append(one)
    return chosen


@pytest.mark.parametrize("component", [Nms(), Nms(by="centre"), Nms(iou=0.5, min_existence=0.6)])
@pytest.mark.parametrize("seed", [1, 2])
def test_it_is_the_plain_loop(component: Nms, seed: int):
    inputs = random_reports(seed, units=4, objects=12, captures=2, runs=2)
    fused = component.fuse(inputs)
    suppressed = 0
    for run in range(2):
        for k, newest in enumerate(inputs.newest):
            given = joined(*(inputs.lists.of(run, f) for f in newest if f >= 0))
            expected = joined(*(one.reshape(1) for one in plainly(component, given)))
            suppressed += len(given) - len(expected)
            assert in_any_order(fused.of(run, k)) == in_any_order(expected)
    assert suppressed > 100


# ------------------------------------------------------------------------- properties

# On a coarse grid ties of all kinds are the rule.
some_entries = st.lists(
    st.builds(
        lambda x, y, existence, of, spread: entry(x, y, existence=existence, of=of, cov=(spread, 0.0, 1.0)),
        st.integers(0, 4).map(float),
        st.integers(0, 2).map(float),
        st.sampled_from([0.1, 0.5, 1.0]),
        st.sampled_from(["car", "vehicle", "pedestrian"]),
        st.sampled_from([1.0, 2.0]),
    ),
    max_size=5,
)


def shuffled(lists: list[list[Entries]], order: list[int], seed: int, captured_s: list[float]) -> Inputs:
    """The units in this order, the entries of each list in another."""
    rng = np.random.default_rng(seed)
    mixed = [joined(*(lists[u][i] for i in rng.permutation(len(lists[u])))) for u in order]
    names = [f"unit {u}" for u in order]
    return inputs_of([mixed], names, [captured_s[u] for u in order], [0.5 + 1e-9 * u for u in order], names=names)


@given(
    st.lists(some_entries, min_size=3, max_size=3), st.permutations(range(3)), st.integers(0, 99),
    st.sampled_from([Nms(), Nms(by="centre"), Nms(iou=0.4)]),
)  # fmt: skip
def test_neither_the_order_of_units_nor_that_of_entries_counts(
    lists: list[list[Entries]], order: list[int], seed: int, component: Nms
):
    captured_s = [0.1, 0.1, 0.2]
    straight = component.fuse(shuffled(lists, [0, 1, 2], 0, captured_s)).entries
    mixed = component.fuse(shuffled(lists, order, seed, captured_s)).entries
    mixed["unit_ix"] = np.array(order)[mixed["unit_ix"]]
    assert in_any_order(mixed) == in_any_order(straight)


def test_a_run_alone_is_the_run_among_others():
    inputs = random_reports(5, units=3, objects=6, captures=2, runs=3)
    fused = Nms().fuse(inputs)
    assert fused.start.shape == (3, len(inputs.issue_s) + 1)
    for run in range(3):
        lists = [inputs.lists.of(run, f) for f in range(len(inputs.unit_ix))]
        names = [inputs.units[u] for u in inputs.unit_ix]
        alone = Nms().fuse(inputs_of([lists], names, inputs.captured_s.tolist(), inputs.arrives_s.tolist()))
        for k in range(len(inputs.issue_s)):
            assert alone.of(0, k).tobytes() == fused.of(run, k).tobytes()


def test_boxes_have_to_share_more_than_fifteen_per_cent_where_nothing_else_is_said():
    # 4 m × 2 m, d apart lengthwise: (4 − d) / (4 + d) in common, 0.15 at d = 3.4 / 1.15 = 2.9565.
    for apart_m, count in ((2.95, 1), (2.96, 2)):
        assert len(kept(Nms(), entry(0.0, existence=0.9), entry(apart_m, existence=0.8))) == count
