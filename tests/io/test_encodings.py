"""The compiled walk through protobuf, and JSON in batches, against a plain walk through the decoded messages."""

import json
import math
import struct
from typing import Any

import pytest
from google.protobuf import descriptor_pb2
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.io.encodings import json as json_messages
from copem_replay.io.encodings.json import JsonDefinition
from copem_replay.io.encodings.protobuf import ProtobufDefinition
from tests.io.test_columns import OBJECTS, Kinds, in_protobuf, schema
from tests.oracles import tree as plain

WHOLE = ("int64", "uint64", "int32", "uint32", "sint32", "sint64", "fixed32", "fixed64", "sfixed32", "sfixed64")
KINDS = ("double", "float", *WHOLE, "bool", "string", "bytes")
EVERY = schema(
    "e",
    {
        "All": "Some one\nrepeated Some many\nSome other",
        "Some": "\n".join(
            [
                *(f"{kind} a_{kind}" for kind in KINDS),
                *(f"optional {kind} o_{kind}" for kind in KINDS),
                *(f"repeated {kind} r_{kind}" for kind in KINDS),
                "Kind kind",
                "repeated Kind kinds",
                "All deeper",
                "repeated Some again",
            ]
        ),
    },
    {"Kind": {"NONE": 0, "CAR": 1, "MINUS": -5}},
)
LIMITS = {"int": (-(2**31), 2**31 - 1), "uint": (0, 2**32 - 1), "long": (-(2**63), 2**63 - 1), "ulong": (0, 2**64 - 1)}
SHARED = {
    "double": st.floats(),
    "float": st.floats(width=32),
    "bool": st.booleans(),
    "string": st.text(st.characters(exclude_categories=["Cs"]), max_size=4) | st.just("1.5"),
    "bytes": st.binary(max_size=3),
}
SHARED |= dict.fromkeys(["int32", "sint32", "sfixed32"], st.integers(*LIMITS["int"]))
SHARED |= dict.fromkeys(["uint32", "fixed32"], st.integers(*LIMITS["uint"]))
SHARED |= dict.fromkeys(["int64", "sint64", "sfixed64"], st.integers(*LIMITS["long"]))
SHARED |= dict.fromkeys(["uint64", "fixed64"], st.integers(*LIMITS["ulong"]))
VALUES: dict[str, st.SearchStrategy[Any]] = {
    **{f"{mark}_{kind}": SHARED[kind] for kind in KINDS for mark in "ao"},
    **{f"r_{kind}": st.lists(SHARED[kind], max_size=3) for kind in KINDS},
    "kind": st.sampled_from([0, 1, -5, 77]),
    "kinds": st.lists(st.sampled_from([0, 1, -5, 77]), max_size=3),
}
SOME: st.SearchStrategy[dict[str, Any]] = st.recursive(
    st.fixed_dictionaries({}, optional=VALUES),
    lambda inner: st.fixed_dictionaries(
        {}, optional={**VALUES, "again": st.lists(inner, max_size=2), "deeper": st.fixed_dictionaries({"one": inner})}
    ),
    max_leaves=4,
)
ALL = st.fixed_dictionaries({}, optional={"one": SOME, "other": SOME, "many": st.lists(SOME, max_size=3)})


def message(definition: ProtobufDefinition, content: dict[str, Any]) -> Any:
    """Filled by the names of its fields."""
    made = definition._parse(b"")

    def fill(target: Any, said: dict[str, Any]) -> None:
        for name, value in said.items():
            if isinstance(value, dict):
                getattr(target, name).SetInParent()
                fill(getattr(target, name), value)
            elif isinstance(value, list) and value and isinstance(value[0], dict):
                for item in value:
                    fill(getattr(target, name).add(), item)
            elif isinstance(value, list):
                getattr(target, name).extend(value)
            else:
                setattr(target, name, value)

    fill(made, content)
    return made


def decoding(definition: ProtobufDefinition) -> Any:
    def decode(payload: bytes) -> Any:
        try:
            return definition._parse(payload)
        except DecodeError:
            raise ValueError from None

    return decode


every, _ = in_protobuf(EVERY, "All")
PATHS = [p for p in every.offers() if p.count(".") < 4]


@given(st.lists(st.lists(ALL, max_size=2), max_size=3), st.lists(st.sampled_from(PATHS), min_size=1, max_size=12))
def test_protobuf_of_every_type(contents: list[list[dict[str, Any]]], paths: list[str]) -> None:
    """Messages one after the other are one message, with what the parser makes of it."""
    payloads = [b"".join(message(every, c).SerializeToString() for c in several) for several in contents]
    plain.holds(every, payloads, decoding(every), plain.protobuf_child, list(dict.fromkeys(paths)))


@given(ALL, st.data())
def test_protobuf_that_was_hit(content: dict[str, Any], data: st.DataObject) -> None:
    payload = bytearray(message(every, content).SerializeToString())
    for _ in range(data.draw(st.integers(0, 3))):
        if payload:
            payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    paths = list(dict.fromkeys(data.draw(st.lists(st.sampled_from(PATHS), min_size=1, max_size=8))))
    plain.holds(every, [b"", bytes(payload), b""], decoding(every), plain.protobuf_child, paths)


def old() -> ProtobufDefinition:
    """A definition of proto2: a closed enumeration, a group, a choice, an own default, a required field."""
    file = descriptor_pb2.FileDescriptorProto(name="old.proto", package="old", syntax="proto2")
    kind = file.enum_type.add(name="Kind")
    kind.value.add(name="CAR", number=1)
    made = file.message_type.add(name="A")
    group = made.nested_type.add(name="G")
    group.field.add(name="x", number=1, label=1, type=Kinds.TYPE_DOUBLE)
    group.field.add(name="g", number=2, label=3, type=Kinds.TYPE_GROUP, type_name=".old.A.G")
    made.oneof_decl.add(name="either")
    made.field.add(name="kind", number=1, label=1, type=Kinds.TYPE_ENUM, type_name=".old.Kind")
    made.field.add(name="kinds", number=2, label=3, type=Kinds.TYPE_ENUM, type_name=".old.Kind")
    made.field.add(name="g", number=3, label=1, type=Kinds.TYPE_GROUP, type_name=".old.A.G")
    made.field.add(name="several", number=4, label=3, type=Kinds.TYPE_GROUP, type_name=".old.A.G")
    made.field.add(name="this", number=5, label=1, type=Kinds.TYPE_INT32, oneof_index=0)
    made.field.add(name="that", number=6, label=1, type=Kinds.TYPE_MESSAGE, type_name=".old.A", oneof_index=0)
    made.field.add(name="five", number=7, label=1, type=Kinds.TYPE_INT32, default_value="5")
    made.field.add(name="needed", number=8, label=2, type=Kinds.TYPE_INT32)
    definition, _ = in_protobuf(file, "A")
    return definition


def double(x: float) -> bytes:
    return b"\x09" + struct.pack("<d", x)


def test_protobuf_2() -> None:
    """By hand: 7 is no Kind; groups within groups; the last of a choice counts; no field is there by default."""
    definition = old()
    inner = b"\x13" + double(2) + b"\x14"  # field 2 of a group
    payloads = [
        b"\x08\x07\x10\x01\x10\x07\x12\x02\x01\x07",
        b"\x08\x01\x1b" + double(1) + inner + b"\x1c\x23" + inner + double(3) + b"\x24\x23\x24",
        b"\x28\x09\x32\x02\x28\x04",
        b"\x32\x02\x28\x04\x28\x09\x40\x01",
    ]
    paths = ["kind", "kinds[]", "g.x", "g.g[].x", "several[].x", "several[].g[].x", "this", "that.this", "five"]
    plain.holds(definition, payloads, decoding(definition), plain.protobuf_child, paths)
    found = definition.shred(payloads, paths, ["kind"])
    numbers = {
        p: [None if math.isnan(v) else v for v in level.numbers[p]]
        for level in found.levels.values()
        for p in level.numbers
    }
    assert numbers["kind"] == [None, 1, None, None]
    assert numbers["kinds[]"] == [1, 1]
    assert (numbers["g.x"], numbers["g.g[].x"]) == ([None, 1, None, None], [2])
    assert (numbers["several[].x"], numbers["several[].g[].x"]) == ([3, None], [2])
    assert (numbers["this"], numbers["that.this"]) == ([None, None, None, 9], [None, None, 4, None])
    assert numbers["five"] == [None] * 4


@pytest.mark.parametrize("size", [1, 50, 10**6])
def test_batches_join(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("copem_replay.io.encodings.columns.BATCH_BYTES", size)
    monkeypatch.setattr(json_messages, "_BATCH_BYTES", size)
    definition, payload = in_protobuf(OBJECTS, "List")
    content = [{"t": k, "objects": [{"id": f"{k}{j}", "kind": "CAR"} for j in range(k % 4)]} for k in range(20)]
    paths = ["t", "objects[].id", "objects[].kind", "objects[].place.x"]
    plain.holds(definition, [payload(c) for c in content], decoding(definition), plain.protobuf_child, paths)
    encoded = [json.dumps(c).encode() for c in content]
    encoded[5] = b'{"t": 5, "objects": [3]}'
    plain.holds(JsonDefinition(encoded), encoded, plain.json_message, plain.json_child, ["t", "objects[].id"])


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(2**70), 2**70) | st.text(max_size=3) | st.just("1.5"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=12,
)


@given(st.lists(JSON, min_size=1, max_size=4), st.data())
def test_any_json(values: list[Any], data: st.DataObject) -> None:
    payloads = [json.dumps({"a": v}).encode() for v in values]
    definition = JsonDefinition(payloads)
    paths = sorted(definition.offers())
    if paths:
        chosen = list(dict.fromkeys(data.draw(st.lists(st.sampled_from(paths), min_size=1, max_size=5))))
        plain.holds(definition, payloads, plain.json_message, plain.json_child, chosen)


def test_digits_that_doubles_do_not_hold() -> None:
    payloads = [b'{"v": 18446744073709551617}', b'{"v": 1}', b'{"v": 1e19}', b'{"v": NaN}', b'{"v": 1e999}']
    level = JsonDefinition(payloads).shred(payloads, ["v"], ["v"]).levels[""]
    words = level.texts["v"].words
    assert [words[k] for k in level.texts["v"].code] == ["18446744073709551617", "1", "1e+19", "nan", "inf"]
    assert level.numbers["v"].tolist()[:3] == [2.0**64, 1.0, 1e19]
