"""Fields of unknown schemas proposed by their names: what is found where, and that what `init` writes runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap.writer import Writer

from copem_replay.core import yaml as plain_yaml
from copem_replay.experiment.draft.fields import propose_fields
from copem_replay.experiment.draft.survey import survey_recording
from tests.experiment.test_template import Call, call, replayed  # noqa: F401
from tests.helpers.messages import SEPARATOR, serialised
from tests.io.test_columns import in_protobuf, schema

START_NS = 1_600_000_000 * 10**9
NAMES = ["track_id", "label", "x", "y", "z", "yaw", "length", "width", "height"]


def numbers(*paths: str, texts: tuple[str, ...] = ()) -> dict[str, str]:
    return dict.fromkeys(paths, "number") | dict.fromkeys(texts, "text")


def read_of(offers: dict[str, str], said: dict[str, list[str]] | None = None, at: int = START_NS) -> dict[str, Any]:
    found = propose_fields(offers, said or {}, [at])
    assert found is not None
    read, missing = found
    assert missing == []
    return read


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        (
            numbers(*NAMES),
            {"id": "track_id", "class": "label", "x_m": "x", "y_m": "y", "z_m": "z", "yaw_rad": "yaw"}
            | {"length_m": "length", "width_m": "width", "height_m": "height"},
        ),
        (
            numbers("pose.position.x", "pose.position.y", "twist.linear.x", "twist.linear.y", "size[]", texts=("id",)),
            {"id": "id", "x_m": "pose.position.x", "y_m": "pose.position.y", "vx_mps": "twist.linear.x"}
            | {"vy_mps": "twist.linear.y", "length_m": "size[0]", "width_m": "size[1]", "height_m": "size[2]"},
        ),
        (
            numbers("id.value", "center[]", "dims.x", "dims.y", "dims.z", *(f"rot.{a}" for a in "xyzw")),
            {"id": "id.value", "x_m": "center[0]", "y_m": "center[1]", "z_m": "center[2]", "length_m": "dims.x"}
            | {"width_m": "dims.y", "height_m": "dims.z", "yaw_rad": {"quaternion": "rot"}},
        ),
        (
            numbers(
                "obj_id",
                "pos_x",
                "pos_y",
                "l",
                "w",
                "heading_deg",
                "vx",
                "vy",
                "kinds[].score",
                texts=("kinds[].label",),
            ),
            {"id": "obj_id", "class": {"path": "kinds[].label", "probability": "kinds[].score"}, "x_m": "pos_x"}
            | {"y_m": "pos_y", "length_m": "l", "width_m": "w", "yaw_rad": {"degrees": "heading_deg"}}
            | {"vx_mps": "vx", "vy_mps": "vy"},
        ),
    ],
)
def test_what_fields_are_called(inside: dict[str, str], expected: dict[str, Any]) -> None:
    offers = {f"things[].{path}": what for path, what in inside.items()}
    assert read_of(offers) == {"objects": "things[]", **expected}


def test_the_list_that_has_most() -> None:
    offers = {f"a.objects[].{p}": "number" for p in NAMES} | {f"lanes[].{p}": "number" for p in ("id", "x", "y")}
    assert read_of(offers)["objects"] == "a.objects[]"


def test_of_several_the_likeliest() -> None:
    read = read_of({f"o[].{p}": "number" for p in (*NAMES, "id", "centre.x", "centre.y")})
    assert (read["id"], read["x_m"]) == ("id", "x")


@pytest.mark.parametrize("names", [[], ["id", "label"], ["velocity.x", "velocity.y", "id", "length", "width"]])
def test_lists_of_no_objects(names: list[str]) -> None:
    assert propose_fields({f"o[].{p}": "number" for p in names} | {"x": "number"}, {}, []) is None


@pytest.mark.parametrize(
    ("path", "word", "expected"),
    [
        ("t", "1600000000.25", "t"),
        ("time", "1600000000250", {"path": "time", "unit": "ms"}),
        ("timestamp", "1600000000250000", {"path": "timestamp", "unit": "us"}),
        ("header.stamp", "1600000000250000000", {"path": "header.stamp", "unit": "ns"}),
        ("time", "2020-09-13T12:26:40Z", "time"),
        ("time", "3", None),  # of no clock that is near that of logging
        ("time", "noon", None),
    ],
)
def test_the_unit_of_a_stamp(path: str, word: str, expected: Any) -> None:
    offers = {f"o[].{p}": "number" for p in NAMES} | {path: "number", "frame_id": "text"}
    read = read_of(offers, {path: [word]})
    assert read.get("stamp") == expected
    assert read["frame"] == "frame_id"


def things(k: int) -> list[dict[str, Any]]:
    """A car that drives past a standing one and a pedestrian."""
    places = (("car", 5.0 * k / 10, 0.0), ("car", 20.0, 4.0), ("pedestrian", 15.0, -6.0 + k / 10))
    return [
        {"track_id": n, "label": what, "x": x, "y": y, "z": 0.8, "yaw": 0.0, "length": 1.5, "width": 1.0, "height": 1.6}
        for n, (what, x, y) in enumerate(places, 1)
    ]


def as_json() -> tuple[str, str, str, bytes, Callable[[Any], bytes]]:
    return "json", "my.Things", "jsonschema", b"{}", lambda message: json.dumps(message).encode()


def as_protobuf() -> tuple[str, str, str, bytes, Callable[[Any], bytes]]:
    fields = "uint64 track_id\nKind label\n" + "\n".join(f"double {name}" for name in NAMES[2:])
    file = schema(
        "my", {"Things": "repeated Thing things", "Thing": fields}, {"Kind": {"NONE": 0, "CAR": 1, "PERSON": 2}}
    )
    _, payload = in_protobuf(file, "Things")

    def encoded(message: Any) -> bytes:
        kind = {"car": "CAR", "pedestrian": "PERSON"}
        return payload({"things": [{**thing, "label": kind[thing["label"]]} for thing in message["things"]]})

    data = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return "protobuf", "my.Things", "protobuf", data, encoded


def as_ros2() -> tuple[str, str, str, bytes, Callable[[Any], bytes]]:
    fields = "uint32 track_id\nstring label\n" + "\n".join(f"float64 {name}" for name in NAMES[2:])
    text = f"Thing[] things\n{SEPARATOR}MSG: my/Thing\n{fields}"
    name = "my/msg/Things"
    return "cdr", name, "ros2msg", text.encode(), lambda message: serialised(text, message, name=name)


def recorded(path: Path, made: tuple[str, str, str, bytes, Callable[[Any], bytes]], leave_out: str = "") -> Path:
    encoding, name, schema_encoding, data, encode = made
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/my/things", encoding, writer.register_schema(name, schema_encoding, data))
        for k in range(40):
            at = START_NS + k * 10**8
            said = [{key: v for key, v in thing.items() if key != leave_out} for thing in things(k)]
            writer.add_message(channel, at, encode({"things": said}), at)
        writer.finish()
    return path


@pytest.mark.parametrize("encoded", [as_json, as_protobuf, as_ros2])
def test_what_init_proposes_runs(encoded: Any, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    recorded(tmp_path / "log.mcap", encoded())
    made = call("init", "log.mcap")
    assert (made.code, made.err) == (0, [])
    (tmp_path / "e.yaml").write_text(made.out, encoding="utf-8")
    assert call("check", "e.yaml").code == 0
    run = call("run", "e.yaml", "--runs", "2", "--jobs", "1")
    assert run.code == 0, run.err
    data, _lines, problems = plain_yaml.parse_yaml(made.out)
    assert problems == []
    assert data["read"] == {
        "topic": "/my/things",
        "objects": "things[]",
        "id": "track_id",
        "class": "label",
        "x_m": "x",
        "y_m": "y",
        "z_m": "z",
        "yaw_rad": "yaw",
        "length_m": "length",
        "width_m": "width",
        "height_m": "height",
    }
    assert made.out.startswith("# Replays log.mcap, 3.9 s: 1 pedestrian, 2 car.")
    informed = call("info", "log.mcap")
    assert informed.code == 2
    assert informed.err[0].startswith("log.mcap: no list of true objects")
    assert "/my/things may be read as a list of objects, by the names of its fields:" in informed.out


def test_what_is_missing_is_said(tmp_path: Path, call: Call) -> None:  # noqa: F811
    recorded(tmp_path / "log.mcap", as_json(), leave_out="width")
    made = call("init", "log.mcap")
    assert made.code == 2
    assert made.err[0].startswith("log.mcap: no list of true objects")
    lines = made.out.splitlines()
    assert lines[0] == "# /my/things (my.Things) may be a list of objects:"
    assert "#   # width_m: …   # needed, and not found: a path, or one number for all" in lines
    assert all(line.startswith("#") for line in lines)
    (proposal,) = survey_recording(tmp_path / "log.mcap").proposals
    assert (proposal.missing, proposal.truth) == (["width_m"], None)
    assert "things[].length" in proposal.offers


def test_fields_that_do_not_read(tmp_path: Path, call: Call) -> None:  # noqa: F811
    """All is there by its name, and no object can be."""
    made = as_json()
    recorded(
        tmp_path / "log.mcap", (*made[:4], lambda m: made[4]({"things": [{**t, "x": np.nan} for t in m["things"]]}))
    )
    found = call("init", "log.mcap")
    assert found.code == 2
    assert "# /my/things: no usable object in 40 messages" in found.out
