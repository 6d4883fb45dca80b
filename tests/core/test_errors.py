"""The fields of errors, from which messages are made and by which callers go."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import pytest

from copem_replay.core.errors import (
    CopemError,
    EgoError,
    EmptyWindowError,
    RecordingError,
    name_first,
    near_name_hint,
    unknown_name_message,
)

LOG = Path("logs/a.mcap")


def test_a_recording_error_names_its_place_and_keeps_it() -> None:
    error = RecordingError("holds no list", path=LOG, topic="/objects", key=("read", "topic"))
    assert error.problems == ("logs/a.mcap: /objects: holds no list",)
    assert (error.path, error.topic, error.key) == (LOG, "/objects", ("read", "topic"))
    assert error.reasons == ("holds no list",)


@pytest.mark.parametrize(
    ("path", "topic", "expected"),
    [
        (LOG, None, "/objects: holds no list"),
        (LOG, "/objects", "holds no list"),
        (Path("logs"), "/objects", "logs/a.mcap: holds no list"),  # of a folder: which file of it
    ],
)
def test_what_a_message_names_already_is_left_out(path: Path, topic: str | None, expected: str) -> None:
    assert RecordingError("holds no list", path=LOG, topic="/objects").within(path, topic) == [expected]


def test_an_ego_error_is_about_the_ego() -> None:
    error = EgoError("no moving object '9'", path=LOG)
    assert str(error) == "logs/a.mcap: ego: no moving object '9'"
    assert (error.key, error.reasons) == (("ego",), ("no moving object '9'",))


def test_names_cannot_break_the_line() -> None:
    error = RecordingError("no\nlist", path=LOG, topic="a\x1b[1m")
    assert error.problems == (r"logs/a.mcap: a\x1b[1m: no\nlist",)
    assert error.within(LOG) == [r"a\x1b[1m: no\nlist"]


@pytest.mark.parametrize(("number", "last"), [(50, "problem 49"), (51, "and 1 more"), (10_000, "and 9,950 more")])
def test_the_first_fifty_problems_are_said(number: int, last: str) -> None:
    error = CopemError([f"problem {k}" for k in range(number)])
    assert str(error).splitlines() == [*(f"problem {k}" for k in range(50)), *([last] if number > 50 else [])]
    assert error.problems[-1] == f"problem {number - 1}"
    assert str(error).splitlines()[-1] == last


def test_the_first_fifty_names_are_said() -> None:
    assert unknown_name_message("unit", "x", ["ego", "rsu"]) == "no unit is named 'x'; there are ego, rsu"
    assert unknown_name_message("unit", "x", []) == "no unit is named 'x'; there are none"
    fifty = ", ".join(f"unit{k}" for k in range(50))
    assert unknown_name_message("unit", "x", [f"unit{k}" for k in range(50)]).endswith(f"; there are {fifty}")
    message = unknown_name_message("unit", "x", [f"unit{k}" for k in range(10_000)])
    assert message == f"no unit is named 'x'; there are {fifty}, … (10,000 in all)"


def test_workers_hand_errors_on_whole() -> None:
    error = pickle.loads(pickle.dumps(EmptyWindowError(["one", "two"], path=LOG, topic="t", key=("window_s",))))
    assert type(error) is EmptyWindowError
    assert error.problems == ("logs/a.mcap: t: one", "logs/a.mcap: t: two")
    assert (error.path, error.topic, error.key) == (LOG, "t", ("window_s",))


@pytest.mark.parametrize(
    ("name", "known", "hint"),
    [
        ("gmm", ["ideal", "union", "nms", "gnn", "tracker"], "; did you mean gnn?"),
        ("traker", ["ideal", "union", "nms", "gnn", "tracker"], "; did you mean tracker?"),
        ("gmm", ["gaussian"], ""),
        ("gmm", ["gnn", "gap"], ""),  # which of them
        ("", ["gnn"], ""),
        ("x", [], ""),
    ],
)
def test_a_name_that_is_alike(name: str, known: list[str], hint: str) -> None:
    assert near_name_hint(name, known) == hint


@pytest.mark.parametrize(
    ("most", "room", "said"),
    [
        (3, math.inf, "gnn, union, late and 2 more"),
        (5, math.inf, "gnn, union, late, alone, nms"),
        (9, 28, "gnn, union, late, alone, nms"),
        (9, 27, "gnn, union, late and 2 more"),
        (9, 26, "gnn, union and 3 more"),
        (9, 3, "gnn and 4 more"),
    ],
)
def test_of_many_names_the_first_are_listed(most: int, room: float, said: str) -> None:
    assert name_first(["gnn", "union", "late", "alone", "nms"], most, room) == said


def test_of_no_names_nothing_is_listed() -> None:
    assert name_first([], 3) == ""
