"""The type that flows: what it refuses, and its selections against lists of entries read out one by one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.core.tracks import (
    CLASS_GROUPS,
    CLASSES,
    UNCERTAINTIES,
    VALUES,
    Scene,
    Tracks,
    append_tracks,
    class_indices,
    splice_rows,
)

Seen = dict[str, list[list[str]]]
"""What each unit lists: its lists in order of capture, each the objects it holds."""

OBJECTS = ("anna", "bert", "carl")


def tracks(seen: Seen, runs: int = 2, exact: tuple[str, ...] = ()) -> Tracks:
    """Tracks of `seen`. Every value of every row is another number; columns of `exact` are None."""
    units = tuple(seen)
    frames = [(unit, k) for unit in units for k in range(len(seen[unit]))]
    start, unit_ix, object_ix, frame_ix = [0], [], [], []
    for u, unit in enumerate(units):
        for o, name in enumerate(OBJECTS):
            held = [frames.index((unit, k)) for k, held in enumerate(seen[unit]) if name in held]
            if held:
                frame_ix += held
                start.append(len(frame_ix))
                unit_ix.append(u)
                object_ix.append(o)
    P, F = len(frame_ix), len(frames)
    number = iter(range(10_000))

    def column(rows: int, width: int) -> Any:
        return np.array([[float(next(number)) for _ in range(width)] for _ in range(rows)]).reshape(rows, width)

    values: dict[str, Any] = {name: column(runs, P) for name in VALUES}
    values |= {name: None if name in exact else column(1, P) for name in UNCERTAINTIES}
    return Tracks(
        units=units,
        start=np.array(start),
        unit_ix=np.array(unit_ix, dtype=int),
        object_ix=np.array(object_ix, dtype=int),
        frame_ix=np.array(frame_ix, dtype=int),
        stamp_ns=np.array([1_000 + 7 * f for f in range(F)], dtype=np.int64),
        captured_s=np.array([7e-9 * f for f in range(F)]),
        frame_unit_ix=np.array([units.index(unit) for unit, _ in frames], dtype=int),
        arrives_s=column(runs, F),
        valid=np.arange(runs * P).reshape(runs, P) % 3 > 0,
        **values,
    )


def lists(of: Tracks) -> list[dict[str, Any]]:
    """All lists with all they say, entry by entry."""
    found = [
        {
            "unit": of.units[of.frame_unit_ix[f]],
            "stamp": int(of.stamp_ns[f]),
            "captured": float(of.captured_s[f]),
            "arrives": of.arrives_s[:, f].tolist(),
            "holds": {},
        }
        for f in range(len(of.stamp_ns))
    ]
    for e in range(len(of.unit_ix)):
        for p in range(of.start[e], of.start[e + 1]):
            entry = found[of.frame_ix[p]]
            assert entry["unit"] == of.units[of.unit_ix[e]], "a track's rows are in its own unit's lists"
            name = OBJECTS[of.object_ix[e]]
            assert name not in entry["holds"]
            columns = {c: getattr(of, c) for c in ("valid", *VALUES, *UNCERTAINTIES)}
            entry["holds"][name] = {c: None if a is None else a[:, p].tolist() for c, a in columns.items()}
    return found


SEEN: Seen = {
    "mast": [["anna"], ["anna", "carl"], []],
    "van": [["bert", "anna"], ["bert"]],
    "ego": [[], ["carl"], ["carl", "anna", "bert"], ["anna"]],
}

seen_by_units = st.dictionaries(
    st.sampled_from(["mast", "van", "ego", "bike"]),
    st.lists(st.lists(st.sampled_from(OBJECTS), unique=True), min_size=0, max_size=4),
    min_size=1,
)


def test_the_example_holds_what_it_says() -> None:
    assert [(entry["unit"], sorted(entry["holds"])) for entry in lists(tracks(SEEN))] == [
        ("mast", ["anna"]), ("mast", ["anna", "carl"]), ("mast", []),
        ("van", ["anna", "bert"]), ("van", ["bert"]),
        ("ego", []), ("ego", ["carl"]), ("ego", ["anna", "bert", "carl"]), ("ego", ["anna"]),
    ]  # fmt: skip


class TestShapes:
    def test_one_run_beside_several_is_allowed(self) -> None:
        of = tracks(SEEN, runs=3)
        assert replace(of, z_m=of.z_m[:1], arrives_s=of.arrives_s[:1], valid=of.valid[:1]).z_m.shape == (1, 11)

    @pytest.mark.parametrize("name", ["start", "object_ix", "captured_s", "frame_unit_ix"])
    def test_a_column_too_short(self, name: str) -> None:
        of = tracks(SEEN)
        with pytest.raises(ValueError, match=rf"Tracks\.{name}: expected shape"):
            replace(of, **{name: getattr(of, name)[:-1]})

    @pytest.mark.parametrize("name", ["arrives_s", "valid", *VALUES, *UNCERTAINTIES])
    def test_a_value_too_narrow(self, name: str) -> None:
        of = tracks(SEEN)
        with pytest.raises(ValueError, match=rf"Tracks\.{name}: expected \(runs, "):
            replace(of, **{name: getattr(of, name)[:, 1:]})

    @pytest.mark.parametrize("name", ["arrives_s", "valid", *VALUES, *UNCERTAINTIES])
    def test_a_value_without_runs(self, name: str) -> None:
        of = tracks(SEEN)
        with pytest.raises(ValueError, match=rf"Tracks\.{name}"):
            replace(of, **{name: getattr(of, name)[0]})

    @pytest.mark.parametrize("name", ["arrives_s", "valid", *VALUES])
    def test_values_that_disagree_on_the_runs(self, name: str) -> None:
        of = tracks(SEEN, runs=3)
        with pytest.raises(ValueError, match="number of runs"):
            replace(of, **{name: getattr(of, name)[:2]})

    @pytest.mark.parametrize("start", [[1, 2, 3], [0, 2, 2], [0, 2, 1], [0, 2, 4], [0, 1, 2]])
    def test_rows_that_are_not_cut_into_tracks(self, start: list[int]) -> None:
        of = tracks({"mast": [["anna", "bert"], ["bert"]]})
        assert of.start.tolist() == [0, 1, 3]
        with pytest.raises(ValueError, match=r"Tracks\.start"):
            replace(of, start=np.array(start))

    def test_rows_of_no_track(self) -> None:
        nobody = np.empty(0, dtype=int)
        for start in ([0], [11]):
            with pytest.raises(ValueError, match=r"Tracks\.start"):
                replace(tracks(SEEN), start=np.array(start), unit_ix=nobody, object_ix=nobody)

    def test_nothing_at_all_is_a_log_too(self) -> None:
        assert lists(tracks({"mast": []})) == []
        assert [entry["holds"] for entry in lists(tracks({"mast": [[], []]}))] == [{}, {}]

    def test_it_is_frozen(self) -> None:
        with pytest.raises(AttributeError):
            tracks(SEEN).x_m = np.zeros((1, 11))  # type: ignore[misc]


@settings(deadline=None)
@given(seen_by_units)
def test_what_each_row_belongs_to(seen: Seen) -> None:
    of = tracks(seen)
    for e in range(len(of.unit_ix)):
        for p in range(of.start[e], of.start[e + 1]):
            assert of.track_ix[p] == e
            assert of.row_object_ix[p] == of.object_ix[e]
            assert of.row_unit_ix[p] == of.unit_ix[e]
            assert of.row_captured_s[p] == of.captured_s[of.frame_ix[p]]
    assert len(of.track_ix) == len(of.row_object_ix) == len(of.row_unit_ix) == len(of.row_captured_s)


@settings(deadline=None)
@given(seen_by_units)
def test_by_frame(seen: Seen) -> None:
    of = tracks(seen)
    order, bounds = of.by_frame
    assert len(bounds) == len(of.stamp_ns) + 1
    assert bounds[0] == 0
    assert bounds[-1] == len(order) == len(of.frame_ix)
    for f in range(len(of.stamp_ns)):
        assert order[bounds[f] : bounds[f + 1]].tolist() == [p for p, g in enumerate(of.frame_ix) if g == f]


@settings(deadline=None)
@given(seen_by_units, st.data())
def test_take_tracks(seen: Seen, data: st.DataObject) -> None:
    of = tracks(seen, exact=("yaw_var_rad2",))
    keep = data.draw(st.lists(st.booleans(), min_size=len(of.unit_ix), max_size=len(of.unit_ix)))
    kept = {(of.units[of.unit_ix[e]], OBJECTS[of.object_ix[e]]) for e, wanted in enumerate(keep) if wanted}
    expected = lists(of)
    for entry in expected:
        entry["holds"] = {o: says for o, says in entry["holds"].items() if (entry["unit"], o) in kept}
    taken = of.take_tracks(np.array(keep, dtype=bool))
    assert lists(taken) == expected
    assert len(taken.unit_ix) == len(kept)


def test_rows_without_states_are_the_same_rows() -> None:
    """Who is where in which list, and whether it is valid, stay; of states nothing does."""
    of = tracks(SEEN)
    rows = np.arange(0, len(of.frame_ix), 2)
    taken, bare = of.take_rows(rows), of.take_rows(rows, states=False)
    for name in ("start", "unit_ix", "object_ix", "frame_ix", "valid"):
        assert getattr(bare, name).tolist() == getattr(taken, name).tolist()
    assert all((getattr(bare, name) == 0.0).all() and getattr(bare, name).strides[1] == 0 for name in VALUES)
    assert [getattr(bare, name) for name in UNCERTAINTIES] == [None] * len(UNCERTAINTIES)
    joined, _ = splice_rows([taken, bare], states=False)
    assert joined.valid.tolist() == splice_rows([taken, taken])[0].valid.tolist()
    assert joined.x_m.strides[1] == 0


def test_rows_in_the_lists_of_others() -> None:
    one, other = tracks(SEEN), tracks(SEEN)
    moved = one.in_lists_of(other)
    assert (moved.stamp_ns is other.stamp_ns, moved.arrives_s is other.arrives_s) == (True, True)
    assert (moved.captured_s is other.captured_s, moved.frame_unit_ix is other.frame_unit_ix) == (True, True)
    assert lists(moved) == lists(one)


def test_taking_leaves_the_original_alone() -> None:
    of, same = tracks(SEEN), tracks(SEEN)
    of.take_tracks(np.arange(len(of.unit_ix)) % 2 == 0)
    assert lists(of) == lists(same)


class TestClasses:
    def test_the_contracts_classes(self) -> None:
        assert CLASSES == (
            "pedestrian", "bicycle", "motorcycle", "car", "van", "truck", "bus", "trailer", "animal", "other",
            "vehicle",
        )  # fmt: skip
        assert set(CLASS_GROUPS) == {"vru", "vehicles"}

    @pytest.mark.parametrize(
        ("names", "expected"),
        [
            (("car",), ["car"]),
            (("truck", "car", "truck"), ["car", "truck"]),
            (("vru",), ["pedestrian", "bicycle", "motorcycle"]),
            (("vehicles",), ["motorcycle", "car", "van", "truck", "bus", "trailer", "vehicle"]),
            (("animal", "vru", "pedestrian"), ["pedestrian", "bicycle", "motorcycle", "animal"]),
            (("vehicles", "vru"), [c for c in CLASSES if c not in ("animal", "other")]),
            ((), []),
        ],
    )
    def test_indices(self, names: tuple[str, ...], expected: list[str]) -> None:
        assert [CLASSES[k] for k in class_indices(names)] == expected


def test_what_follows_without_variances_has_none_to_speak_of() -> None:
    seen = {"a": [["anna"], ["bert"]]}
    stating, exact = tracks(seen, runs=1), tracks(seen, runs=1, exact=UNCERTAINTIES)
    one_way, other_way, never = (
        append_tracks(stating, exact),
        append_tracks(exact, stating),
        append_tracks(exact, exact),
    )
    for name in UNCERTAINTIES:
        stated = getattr(stating, name)[0].tolist()
        assert getattr(one_way, name).tolist() == [[*stated, 0.0, 0.0]]
        assert getattr(other_way, name).tolist() == [[0.0, 0.0, *stated]]
        assert getattr(never, name) is None
    assert one_way.start.tolist() == [0, 1, 2, 3, 4]
    assert one_way.object_ix.tolist() == [0, 1, 0, 1]


def test_scene() -> None:
    scene = Scene(
        log="a",
        t0_ns=1_700_000_000_000_000_000,
        end_ns=1_700_000_002_500_000_000,
        object_ids=OBJECTS,
        object_class=np.zeros(3, dtype=np.int8),
        moving=np.ones(3, dtype=bool),
    )
    assert scene.end_s == 2.5
    assert scene.object_number == {"anna": 0, "bert": 1, "carl": 2}
    assert scene.ego_ix == -1
