"""Global nearest neighbour by hand, against NumPy and SciPy, and what must hold whatever the lists."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from copem_replay.core.object_list import ENTRY, Entries, Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import CLASSES
from copem_replay.fusion.gnn import Gnn
from copem_replay.fusion.inputs import sort_rows
from tests.helpers.reports import entry, inputs_of, joined
from tests.oracles import gnn as gnn_oracle
from tests.oracles.gnn import in_any_order, random_reports

CORRELATED = {
    "inverse_covariance_intersection": {},
    "split_covariance_intersection": {"dependent_share": 0.4},
    "cross_covariance": {"correlation": 0.3},
    "covariance_union": {"conflict_gate": 0.9},
}
"""Ways to combine errors that hang together, with the one number they have."""
COMBINATIONS = (
    "inverse_variance", "covariance_intersection", "fast_covariance_intersection", *CORRELATED,
)  # fmt: skip
INTERSECTIONS = COMBINATIONS[1:3]
WIDE, HIGH = (4.0, 0.0, 1.0), (1.0, 0.0, 4.0)


def together(*lists: Entries, captured_s: list[float] | None = None) -> Inputs:
    """Lists of as many units, all there at 0.5 s."""
    names = [f"unit {k}" for k in range(len(lists))]
    return inputs_of([lists], names, captured_s or [0.0] * len(lists), [0.5] * len(lists))


def fused(*lists: Entries, **settings: object) -> Entries:
    """The fused list, from west to east."""
    entries = Gnn(**settings).fuse(together(*lists)).of(0, 0)
    return entries[np.argsort(entries["x_m"])]


def xs(*lists: Entries, **settings: object) -> list[float]:
    return fused(*lists, **settings)["x_m"].tolist()


def covariance(entries: Entries) -> np.ndarray:
    columns = [entries[f"cov_{name}_m2"] for name in ("ee", "en", "en", "nn")]
    return np.stack(columns, axis=-1).reshape(-1, 2, 2)


# ------------------------------------------------------------------------- positions, two units and one object


def test_independent_errors_are_combined_by_inverse_variance():
    one = fused(entry(0.0, 0.0, cov=WIDE), entry(1.0, 1.0, cov=HIGH))
    assert one[["x_m", "y_m"]].tolist() == [pytest.approx((0.8, 0.2), abs=1e-12)]
    assert covariance(one)[0] == pytest.approx(0.8 * np.eye(2), abs=1e-12)


@pytest.mark.parametrize("minimise", ["trace", "determinant"])
@pytest.mark.parametrize("combine", INTERSECTIONS)
def test_intersected_covariances_do_not_shrink(combine: str, minimise: str):
    one = fused(entry(0.0, 0.0, cov=WIDE), entry(1.0, 1.0, cov=HIGH), combine=combine, minimise=minimise)
    assert one[["x_m", "y_m"]].tolist() == [pytest.approx((0.8, 0.2), abs=1e-9)]
    assert covariance(one)[0] == pytest.approx(1.6 * np.eye(2), abs=1e-9)


def test_intersection_is_of_all_members_at_once():
    # Three tracks of MathWorks' documentation, without the third axis; weights as in the table of the vectors.
    lists = [entry(1.0, 2.0, cov=(10, 5, 10)), entry(2.0, 2.0, cov=(10, -5, 10)), entry(2.0, 3.0, cov=(12, 9, 12))]
    one = fused(*lists, combine="covariance_intersection", minimise="determinant")
    assert one[["x_m", "y_m"]].tolist() == [pytest.approx((1.68125, 2.53125), abs=1e-6)]
    assert covariance(one)[0] == pytest.approx(np.array([[6.6, 1.8], [1.8, 6.6]]), abs=1e-6)


def test_fast_intersection_is_no_worse_than_the_best_member():
    one = fused(entry(1.0, 2.0, cov=(4, 0, 5)), entry(4.0, 5.0, cov=(7, 0, 8)), combine="fast_covariance_intersection")
    assert one[["x_m", "y_m", "cov_ee_m2", "cov_en_m2", "cov_nn_m2"]].tolist() == [(1.0, 2.0, 4.0, 0.0, 5.0)]


def test_exact_states_count_as_nearly_exact():
    for cov in ((0.0, 0.0, 0.0), (1e-12, 0.0, 1e-12)):
        one = fused(entry(3.0, cov=cov), entry(3.0, cov=cov))
        assert covariance(one)[0] == pytest.approx(0.5e-9 * np.eye(2), rel=1e-9)
    # Singular along the diagonal: as certain across it as can be.
    (found,) = covariance(fused(entry(0.0, cov=(1.0, 1.0, 1.0))))
    assert np.linalg.eigvalsh(found) == pytest.approx([1e-9, 2.0], rel=1e-6)


# ------------------------------------------------------------------------- who belongs together


def test_the_least_total_cost_decides_not_the_nearest():
    # 1.6 is nearer to 3 than to 0, but then 4.5 would be left alone.
    units = [joined(entry(0.0), entry(3.0)), joined(entry(1.6), entry(4.5))]
    assert xs(*units) == pytest.approx([0.8, 3.75])


@pytest.mark.parametrize(("gate", "inside", "outside"), [(0.99, 4.29, 4.30), (0.5, 1.66, 1.67)])
def test_the_gate_is_a_quantile_of_chi_square(gate: float, inside: float, outside: float):
    # S = 2: d² = x²/2 against −2 ln(1 − gate), 9.2103 and 1.3863.
    assert xs(entry(0.0), entry(inside), gate=gate) == [inside / 2]
    assert xs(entry(0.0), entry(outside), gate=gate) == [0.0, outside]
    assert len(fused(entry(0.0), entry(0.0, inside), gate=gate)) == 1
    assert len(fused(entry(0.0), entry(0.0, outside), gate=gate)) == 2


def test_the_gate_turns_with_the_covariance():
    # Long along the diagonal: (3, 3) is 18/20 away, (3, −3) 18/0.4.
    cov = (5.1, 4.9, 5.1)
    assert len(fused(entry(0.0, 0.0, cov=cov), entry(3.0, 3.0, cov=cov))) == 1
    assert len(fused(entry(0.0, 0.0, cov=cov), entry(3.0, -3.0, cov=cov))) == 2


def test_a_vague_cluster_does_not_draw_what_is_nearer_to_a_sure_one():
    # At 1: d² is 2 from the sure one at 0 and 4/9 from the vague one at 3, with ln|S| 0.6 and 4.8.
    sure, vague = (0.25, 0.0, 0.25), (8.75, 0.0, 8.75)
    found = fused(joined(entry(0.0, cov=sure), entry(3.0, cov=vague)), entry(1.0, cov=sure))
    assert found["x_m"].tolist() == pytest.approx([0.5, 3.0])


@pytest.mark.parametrize("combine", COMBINATIONS)
@pytest.mark.parametrize("sigma_m", [None, 0.5, 1.2, 10.0, 1e3])
def test_who_is_who_here_does_not_depend_on_what_is_far_away(sigma_m: float | None, combine: str):
    # To pair all four, 0.1 with −3.1 and 3.1 with 0, costs d² of 9.925; the two in the middle and two alone, 9.215.
    far = [] if sigma_m is None else [entry(500.0, of="truck", cov=(sigma_m**2, 0.0, sigma_m**2))]
    units = [joined(*(entry(x, of="pedestrian") for x in here), *far) for here in ((0.1, 3.1), (0.0, -3.1))]
    assert xs(*units, combine=combine) == pytest.approx([-3.1, 0.05, 3.1] + [500.0] * len(far))


def test_what_is_joined_to_a_vague_pair_by_others_shares_its_price():
    # As above; but now a vague pair is within reach of 3.1, and to be alone costs its ln|S| more.
    vague = [entry(6.0, of="pedestrian", cov=(4.0, 0.0, 4.0))]
    units = [joined(*(entry(x, of="pedestrian") for x in here), *vague) for here in ((0.1, 3.1), (0.0, -3.1))]
    assert xs(*units) == pytest.approx([-1.5, 1.55, 6.0])


def test_no_unit_is_twice_in_one_cluster():
    assert xs(entry(0.0), joined(entry(0.3), entry(0.1))) == pytest.approx([0.05, 0.3])
    assert xs(joined(entry(0.0), entry(0.0))) == [0.0, 0.0]


def test_a_cluster_is_where_its_members_so_far_are():
    # After 0 and 0: variance 0.5 where information is summed, so 4 is 16/1.5 away; intersected 1, and 16/2.
    units = [entry(0.0), entry(0.0), entry(4.0)]
    inputs = together(*units, captured_s=[0.3, 0.2, 0.1])
    assert sorted(Gnn().fuse(inputs).entries["x_m"]) == [0.0, 4.0]
    for combine in INTERSECTIONS:
        assert Gnn(combine=combine).fuse(inputs).entries["x_m"] == pytest.approx([4 / 3])


@pytest.mark.parametrize(
    ("classes", "count"),
    [
        (("car", "pedestrian"), 2),
        (("car", "truck"), 2),
        (("car", "vehicle"), 1),
        (("pedestrian", "vehicle"), 2),
        (("pedestrian", "other"), 1),
    ],
)
def test_only_classes_that_agree_are_joined(classes: tuple[str, str], count: int):
    assert len(fused(entry(0.0, of=classes[0]), entry(0.0, of=classes[1]))) == count


@pytest.mark.parametrize("named", ["car", "pedestrian", "vehicle"])
def test_nothing_said_of_the_class_agrees_with_all(named: str):
    silent = entry(0.0, class_probability=np.zeros(len(CLASSES)))
    for lists in ([silent, entry(0.0, of=named)], [entry(0.0, of=named), silent]):
        (one,) = Gnn().fuse(together(*lists, captured_s=[0.2, 0.1])).entries
        assert one["class_probability"][CLASSES.index(named)] == 0.5
    # What has been joined is what was said of it.
    lists = [silent, entry(0.0, of=named), entry(0.0, of="bicycle")]
    assert len(Gnn().fuse(together(*lists, captured_s=[0.3, 0.2, 0.1])).entries) == 2


def test_a_cluster_is_of_the_class_its_members_make_most_probable():
    # At first `other`, which agrees with everything; the car makes it one: 1.4 of 2.
    unsure = np.zeros(len(CLASSES))
    unsure[[CLASSES.index("other"), CLASSES.index("car")]] = 0.6, 0.4
    units = [entry(0.0, class_probability=unsure), entry(0.0, of="car"), entry(0.0, of="bicycle")]
    found = Gnn().fuse(together(*units, captured_s=[0.3, 0.2, 0.1])).entries
    probability = found["class_probability"][:, [CLASSES.index(c) for c in ("bicycle", "car", "other")]]
    assert sorted(probability.tolist()) == [pytest.approx([0, 0.7, 0.3]), [1.0, 0.0, 0.0]]


def test_newer_lists_come_first_then_longer_ones_then_the_west():
    # Three in a row within the gate of their neighbours only: who comes first takes the one in the middle.
    west, middle, east = entry(-3.0), entry(0.0), entry(3.0)
    for captured_s, expected in (
        ([0.3, 0.2, 0.1], [-1.5, 3.0]),
        ([0.1, 0.2, 0.3], [-3.0, 1.5]),
        ([0.1, 0.1, 0.1], [-1.5, 3.0]),
    ):
        found = Gnn(gate=0.97).fuse(together(west, middle, east, captured_s=captured_s)).entries
        assert sorted(found["x_m"]) == pytest.approx(expected)
    far = entry(100.0)
    assert xs(west, middle, joined(east, far), gate=0.97) == pytest.approx([-3.0, 1.5, 100.0])


# ------------------------------------------------------------------------- what else a fused entry says


def test_units_confirm_each_other():
    found = fused(entry(0.0, existence=0.5), entry(0.0, existence=0.8), entry(0.0, existence=0.1))
    assert found["existence"] == pytest.approx([1 - 0.5 * 0.2 * 0.9])
    assert fused(entry(0.0, existence=0.3))["existence"] == pytest.approx([0.3])


def test_less_likely_entries_are_left_out():
    lists = [entry(0.0, existence=0.4), joined(entry(1.0, existence=0.6), entry(9.0, existence=0.5))]
    assert xs(*lists, min_existence=0.5) == [1.0, 9.0]
    assert xs(*lists, min_existence=0.51) == [1.0]


@pytest.mark.parametrize("combine", COMBINATIONS)
def test_the_rest_is_weighed_by_the_trace_of_the_position_covariance(combine: str):
    # Traces 2 and 6: three quarters to one.
    names = ("z_m", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")
    found = fused(
        entry(0.0, **dict.fromkeys(names, 1.0)),
        entry(0.0, cov=(3.0, 0.0, 3.0), **dict.fromkeys(names, 5.0)),
        combine=combine,
    )
    assert [found[name][0] for name in names] == pytest.approx([2.0] * 6)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [(3.1, -3.1, math.pi), (0.2, 0.4, 0.3), (3.0, -3.1, (3.0 + 2 * math.pi - 3.1) / 2), (7.0, 7.0, 7.0 - 2 * math.pi)],
)
def test_yaw_is_the_mean_on_the_circle(first: float, second: float, expected: float):
    (yaw_rad,) = fused(entry(0.0, yaw_rad=first), entry(0.0, yaw_rad=second))["yaw_rad"]
    assert -math.pi <= yaw_rad <= math.pi
    assert math.remainder(yaw_rad - expected, 2 * math.pi) == pytest.approx(0, abs=1e-12)


def test_opposite_yaws_leave_the_first_ones():
    found = Gnn().fuse(together(entry(0.0, yaw_rad=-2.0), entry(0.0, yaw_rad=math.pi - 2.0), captured_s=[0.1, 0.2]))
    assert found.entries["yaw_rad"] == pytest.approx([math.pi - 2.0])


def test_a_stale_list_is_taken_as_it_is_until_it_is_too_old():
    lists = [entry(0.0), entry(2.0), entry(2.0)]
    found = Gnn().fuse(inputs_of([lists], ["a", "b", "b"], [0.0, 0.9, 1.1], [0.0, 0.9, 1.1]))
    assert found.start.tolist() == [[0, 1, 2, 3]]
    assert found.entries["x_m"].tolist() == [0.0, 1.0, 2.0]
    assert found.entries["captured_s"].tolist() == [0.0, 0.9, 1.1]
    assert found.entries["unit_ix"].tolist() == [0, 0, 1]
    assert found.entries["track_id"].tolist() == [-1] * 3


def test_the_unit_is_the_one_that_was_there_first():
    for arrives_s, first in (([0.2, 0.1], 1), ([0.1, 0.2], 0), ([0.2, 0.2], 0)):
        inputs = inputs_of([[entry(0.0), entry(0.1)]], ["a", "b"], [0.05, 0.0], arrives_s, names=["a", "b"])
        found = Gnn().fuse(inputs).of(0, len(inputs.issue_s) - 1)
        assert found["unit_ix"].tolist() == [first]
        assert found["captured_s"].tolist() == [0.05]


def test_lists_without_entries_and_no_lists_at_all():
    nothing = entries_of(0)
    empty = Gnn().fuse(inputs_of([[nothing, nothing]] * 2, ["a", "b"], [0.0, 0.1], [0.0, 0.1]))
    assert empty.start.tolist() == [[0, 0, 0]] * 2
    never = Gnn().fuse(inputs_of([[entry(0.0)]], ["a"], [0.0], [np.inf]))
    assert never.start.tolist() == [[0]]
    assert len(Gnn().fuse(inputs_of([[]], [], [], [], names=["a"])).entries) == 0
    assert xs(nothing, entry(1.0), nothing) == [1.0]


@pytest.mark.parametrize("combine", COMBINATIONS)
def test_one_entry_stays_what_it_is(combine: str):
    probability = np.linspace(0, 1, len(CLASSES)) * 2 / len(CLASSES)
    one = entry(
        1e6, -2e6, cov=(2.0, 0.5, 1.0), z_m=3.0, yaw_rad=1.0, vx_mps=4.0, vy_mps=5.0, existence=0.25,
        class_probability=probability, captured_s=0.0, unit_ix=0,
    )  # fmt: skip
    (found,) = fused(one, combine=combine)
    for name in ENTRY.names or ():
        assert found[name] == pytest.approx(one[name][0], rel=1e-15, abs=1e-15), name


# ------------------------------------------------------------------------- errors that hang together


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ({"combine": "split_covariance_intersection", "dependent_share": 0.0}, "inverse_variance"),
        ({"combine": "split_covariance_intersection", "dependent_m2": 0.0}, "inverse_variance"),
        ({"combine": "cross_covariance", "correlation": 0.0}, "inverse_variance"),
        ({"combine": "split_covariance_intersection", "dependent_share": 1.0}, "covariance_intersection"),
        ({"combine": "split_covariance_intersection", "dependent_m2": 1e6}, "covariance_intersection"),
    ],
)
def test_limits_are_the_ways_that_were_there_to_the_bit(limit: dict[str, object], expected: str):
    inputs = random_reports(11, units=6, objects=20, captures=3, runs=2)
    found, plain = Gnn(**limit).fuse(inputs), Gnn(combine=expected).fuse(inputs)
    assert found.start.tolist() == plain.start.tolist()
    assert found.entries.tobytes() == plain.entries.tobytes()


def test_a_dependent_variance_is_one_of_every_axis():
    # 1 and 1 m², of which .5 is dependent: as a dependent share of one half; (.5·2 + .5)/2 = .75.
    one = fused(entry(0.0), entry(1.0), combine="split_covariance_intersection", dependent_m2=0.5)
    assert one["x_m"] == pytest.approx([0.5])
    assert covariance(one)[0] == pytest.approx(0.75 * np.eye(2))


def test_what_contradicts_each_other_about_one_object_is_united():
    # 4 m long cars 3 m apart, ± 0.3 m each: far beyond the gate, yet the boxes overlap.
    cars = entry(0.0, cov=(0.09, 0.0, 0.09)), entry(3.0, cov=(0.09, 0.0, 0.09))
    assert xs(*cars) == [0.0, 3.0]
    one = fused(*cars, combine="covariance_union")
    assert one["x_m"] == pytest.approx([1.5])
    assert covariance(one)[0] == pytest.approx(np.diag([0.09 + 1.5**2, 0.09]), abs=1e-9)
    assert one["existence"] == [1.0]
    # Beside each other, of other classes, or both said by one unit: two objects.
    for other in (entry(4.1, cov=(0.09, 0.0, 0.09)), entry(3.0, of="pedestrian", cov=(0.09, 0.0, 0.09))):
        assert len(fused(cars[0], other, combine="covariance_union")) == 2
    assert len(fused(joined(*cars), entry(20.0), combine="covariance_union")) == 3
    assert len(fused(joined(*cars), entry(1.5, cov=(0.01, 0.0, 0.01)), combine="covariance_union")) == 2


def test_within_the_gate_of_conflicts_union_is_inverse_variance():
    pair = entry(0.0), entry(2.0)
    apart = fused(*pair, combine="covariance_union", conflict_gate=0.5)  # d² = 2 > 1.386
    assert covariance(apart)[0] == pytest.approx(np.diag([2.0, 1.0]))
    near = fused(*pair, combine="covariance_union", conflict_gate=0.7)  # 2.41
    assert covariance(near)[0] == pytest.approx(np.diag([0.5, 0.5]))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"combine": "split_covariance_intersection"}, {"dependent_share": 0.5}),
        ({"combine": "split_covariance_intersection", "dependent_m2": 0.2}, {"dependent_m2": 0.2}),
        ({"combine": "cross_covariance"}, {"correlation": 0.5}),
        ({"combine": "covariance_union"}, {"conflict_gate": 0.99}),
        ({"combine": "covariance_union", "gate": 0.999}, {"conflict_gate": 0.999}),
        ({"combine": "inverse_covariance_intersection"}, {}),
        ({}, {}),
    ],
)
def test_an_experiment_that_is_written_back_says_what_it_goes_by(
    settings: dict[str, object], expected: dict[str, object]
):
    common = {"kind", "combine", "minimise", "gate", "min_existence"}
    said = Gnn(**settings).model_dump()
    assert {name: value for name, value in said.items() if name not in common} == expected
    assert Gnn(**said) == Gnn(**settings)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"dependent_share": 0.5}, "dependent_share: expected only with combine: split_covariance_intersection"),
        ({"combine": "cross_covariance", "dependent_m2": 0.5}, "found with cross_covariance"),
        ({"combine": "covariance_intersection", "correlation": 0.5}, "correlation: expected only with"),
        ({"conflict_gate": 0.9}, "conflict_gate: expected only with combine: covariance_union"),
        (
            {"combine": "split_covariance_intersection", "dependent_share": 0.5, "dependent_m2": 0.1},
            "dependent_m2: expected alone",
        ),
        ({"combine": "cross_covariance", "correlation": 1.0}, "less than 1"),
        ({"combine": "split_covariance_intersection", "dependent_share": 1.5}, "less than or equal to 1"),
        ({"combine": "split_covariance_intersection", "dependent_m2": -1.0}, "greater than or equal to 0"),
    ],
)
def test_keys_of_another_way_to_combine_are_refused(settings: dict[str, object], said: str):
    with pytest.raises(ValidationError, match=said):
        Gnn(**settings)


@pytest.mark.parametrize("wrong", [{"gate": 0.0}, {"gate": 1.0}, {"combine": "mean"}, {"min_existence": 2.0}])
def test_what_is_no_setting_is_refused(wrong: dict[str, object]):
    with pytest.raises(ValidationError):
        Gnn(**wrong)


# ------------------------------------------------------------------------- against NumPy and SciPy


def assert_same(found: ObjectLists, expected: ObjectLists, tolerance: dict[str, float]) -> None:
    assert found.start.tolist() == expected.start.tolist()
    for name in ENTRY.names or ():
        off = np.abs(found.entries[name] - expected.entries[name])
        if name == "yaw_rad":
            off = np.minimum(off, 2 * np.pi - off)
        assert off.max(initial=0.0) <= tolerance.get(name, 1e-9), name


@pytest.mark.parametrize("combine", COMBINATIONS)
@pytest.mark.parametrize(
    ("units", "objects", "captures", "together"),
    [(2, 3, 6, False), (5, 10, 3, False), (20, 15, 2, True), (6, 60, 2, True)],
)
def test_it_is_the_plain_program(units: int, objects: int, captures: int, together: bool, combine: str):
    inputs = random_reports(units, units=units, objects=objects, captures=captures, runs=2, together=together)
    settings = {"combine": combine, "min_existence": 0.15}
    own = CORRELATED.get(combine, {})
    # Where the criterion is flat, what a general optimiser finds is the less accurate of the two.
    general = combine.endswith("covariance_intersection") and not combine.startswith("fast")
    close = 1e-4 if general else 1e-6 if combine == "covariance_union" else 1e-9
    tolerance = dict.fromkeys(("x_m", "y_m", "cov_ee_m2", "cov_en_m2", "cov_nn_m2"), close)
    expected = gnn_oracle.fuse(inputs, **settings, setting=next(iter(own.values()), 0.0))
    assert_same(Gnn(**settings, **own).fuse(inputs), expected, tolerance)


def test_crowds_are_assigned_as_by_the_plain_program():
    # Thirty objects to 100 m² instead of one: every entry has several clusters to choose from.
    inputs = random_reports(3, units=6, objects=40, captures=2)
    for name in ("x_m", "y_m"):
        inputs.lists.entries[name] /= math.sqrt(30)
    found = Gnn(gate=0.999).fuse(inputs)
    assert_same(found, gnn_oracle.fuse(inputs, gate=0.999), {})


# ------------------------------------------------------------------------- properties

# On a coarse grid ties of all kinds are the rule.
some_entries = st.lists(
    st.builds(
        lambda x, y, of, cov, existence: entry(x, y, of=of, cov=cov, existence=existence, yaw_rad=x),
        st.integers(-3, 3).map(float),
        st.integers(0, 1).map(float),
        st.sampled_from(["car", "vehicle", "other", "pedestrian"]),
        st.sampled_from([(1.0, 0.0, 1.0), (2.0, 0.9, 0.5), (0.1, 0.0, 3.0)]),
        st.sampled_from([0.5, 0.9]),
    ),
    max_size=4,
)


def shuffled(lists: list[list[Entries]], order: list[int], seed: int, captured_s: list[float]) -> Inputs:
    """The units in this order, the entries of each list in another."""
    rng = np.random.default_rng(seed)
    mixed = [joined(*(lists[u][i] for i in rng.permutation(len(lists[u])))) for u in order]
    names = [f"unit {u}" for u in order]
    return inputs_of([mixed], names, [captured_s[u] for u in order], [0.5 + 1e-9 * u for u in order], names=names)


@given(
    st.lists(some_entries, min_size=4, max_size=4), st.permutations(range(4)), st.integers(0, 99),
    st.sampled_from(COMBINATIONS),
)  # fmt: skip
def test_neither_the_order_of_units_nor_that_of_entries_counts(
    lists: list[list[Entries]], order: list[int], seed: int, combine: str
):
    captured_s = [0.1, 0.1, 0.1, 0.2]
    straight = Gnn(combine=combine).fuse(shuffled(lists, [0, 1, 2, 3], 0, captured_s)).entries
    mixed = Gnn(combine=combine).fuse(shuffled(lists, order, seed, captured_s)).entries
    mixed["unit_ix"] = np.array(order)[mixed["unit_ix"]]
    assert in_any_order(mixed) == in_any_order(straight)


@given(st.lists(some_entries, min_size=3, max_size=3), st.sampled_from(COMBINATIONS))
def test_nothing_is_lost_and_covariances_are_positive_definite(lists: list[list[Entries]], combine: str):
    found = Gnn(combine=combine).fuse(shuffled(lists, [0, 1, 2], 0, [0.0] * 3)).entries
    assert max(map(len, lists)) <= len(found) <= sum(map(len, lists))
    # Every entry leaves its factor in the existence of one cluster.
    nobody = math.prod(1 - one["existence"][0] for entries in lists for one in entries)
    assert math.prod(1 - found["existence"]) == pytest.approx(nobody, rel=1e-9)
    assert (np.linalg.eigvalsh(covariance(found)) > 0).all()
    assert found["class_probability"].sum(axis=1) == pytest.approx(np.ones(len(found)))


@pytest.mark.parametrize("combine", COMBINATIONS)
def test_a_run_alone_is_the_run_among_others(combine: str):
    inputs = random_reports(5, units=3, objects=6, captures=2, runs=3)
    found = Gnn(combine=combine).fuse(inputs)
    assert found.start.shape == (3, len(inputs.issue_s) + 1)
    names = [inputs.units[u] for u in inputs.unit_ix]
    for run in range(3):
        lists = [inputs.lists.of(run, f) for f in range(len(inputs.unit_ix))]
        alone = Gnn(combine=combine).fuse(
            inputs_of([lists], names, inputs.captured_s.tolist(), inputs.arrives_s.tolist())
        )
        for k in range(len(inputs.issue_s)):
            assert alone.of(0, k).tobytes() == found.of(run, k).tobytes()


@given(st.lists(st.tuples(*[st.integers(0, 2)] * 3), max_size=80), st.integers(0, 99))
def test_rows_are_sorted_column_by_column_and_stably(rows: list[tuple[int, int, int]], seed: int):
    values = np.array(rows, dtype=float).reshape(len(rows), 3)
    order = np.random.default_rng(seed).permutation(len(rows))
    expected = sorted(order.tolist(), key=lambda i: rows[i])
    sort_rows(values, order)
    assert order.tolist() == expected


def test_the_whole_scene_elsewhere_is_the_same_scene():
    # A map's coordinates are millions of metres: no digits of the covariance may go there.
    near = random_reports(7, units=4, objects=8, captures=2)
    far = random_reports(7, units=4, objects=8, captures=2)
    far.lists.entries["x_m"] += 500_000.0
    far.lists.entries["y_m"] += 5_000_000.0
    here, there = Gnn().fuse(near), Gnn().fuse(far)
    assert there.start.tolist() == here.start.tolist()
    assert there.entries["x_m"] - 500_000.0 == pytest.approx(here.entries["x_m"], abs=1e-6)
    assert there.entries["y_m"] - 5_000_000.0 == pytest.approx(here.entries["y_m"], abs=1e-6)
    assert covariance(there.entries) == pytest.approx(covariance(here.entries), rel=1e-6)
