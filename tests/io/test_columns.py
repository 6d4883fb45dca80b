"""JSON and protobuf taken apart, one item of a list chosen, and the same content in three encodings."""

import json
import math
import struct
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.io.channel import DefinitionError
from copem_replay.io.encodings.columns import (
    Definition,
    LevelRows,
    ShreddedMessages,
    ancestor_rows,
    common_level,
    format_number,
    list_level,
    list_levels,
    parent_level,
    shred_messages,
)
from copem_replay.io.encodings.json import JsonDefinition
from copem_replay.io.encodings.protobuf import ProtobufDefinition
from tests.helpers.messages import SEPARATOR, defined, serialised, texts

Kinds = descriptor_pb2.FieldDescriptorProto


def encoded(*messages: Any) -> list[bytes]:
    return [json.dumps(m).encode() for m in messages]


def in_json(*messages: Any) -> tuple[JsonDefinition, list[bytes]]:
    payloads = encoded(*messages)
    return JsonDefinition(payloads), payloads


def column(found: ShreddedMessages, path: str) -> list[Any]:
    """Numbers with None for NaN, or texts."""
    level = found.levels[list_level(path)]
    if path in level.numbers:
        return [None if math.isnan(v) else v for v in level.numbers[path]]
    return texts(level.texts[path])


def schema(package: str, messages: dict[str, str], enums: dict[str, dict[str, int]] | None = None) -> Any:
    """A protobuf schema as a recording has it: fields as `[repeated|optional] type name`, by message."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    for name, values in (enums or {}).items():
        made = file.enum_type.add(name=name)
        for value, number in values.items():
            made.value.add(name=value, number=number)
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for number, line in enumerate(fields.strip().splitlines(), 1):
            *label, kind, ident = line.split()
            known = f"TYPE_{kind.upper()}" in Kinds.Type.keys()  # noqa: SIM118
            made = message.field.add(name=ident, number=number, label=3 if label == ["repeated"] else 1)
            if known:
                made.type = Kinds.Type.Value(f"TYPE_{kind.upper()}")
            else:
                made.type = Kinds.TYPE_ENUM if kind in (enums or {}) else Kinds.TYPE_MESSAGE
                made.type_name = f".{package}.{kind}"
            if label == ["optional"]:
                made.proto3_optional, made.oneof_index = True, len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{ident}")
    return file


def in_protobuf(file: Any, name: str) -> tuple[ProtobufDefinition, Callable[[dict[str, Any]], bytes]]:
    data = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    made = SimpleNamespace(id=1, name=f"{file.package}.{name}", encoding="protobuf", data=data)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(made.name))

    def payload(content: dict[str, Any]) -> bytes:
        encoded: bytes = json_format.ParseDict(content, kind()).SerializeToString()
        return encoded

    return ProtobufDefinition(made.name, made), payload


# ------------------------------------------------------------------------------------------------ paths and levels


def test_levels() -> None:
    assert list_level("a.b") == ""
    assert list_level("a[].b[].c.d") == "a[].b[]"
    assert [parent_level(level) for level in ("a[].b[]", "a[]", "a[][]", "[]")] == ["a[]", "", "a[]", ""]
    assert list_levels(["a[].b[].c", "d[].e", "f"]) == ["", "a[]", "d[]", "a[].b[]"]
    assert common_level("a[].b[]", "a[].c[]") == "a[]"
    assert common_level("a[]", "b[]") == ""
    assert common_level("a[].b[]", "a[].b[]") == "a[].b[]"


def test_numbers_as_text_lose_nothing() -> None:
    assert [format_number(v) for v in (1.0, -0.0, 3, 2**63, 1533151603.123456, 1e300, math.nan)] == [
        "1",
        "0",
        "3",
        "9223372036854775808",
        "1533151603.123456",
        "1e+300",
        "nan",
    ]


# ------------------------------------------------------------------------------------------------ JSON


def test_json() -> None:
    definition, payloads = in_json(
        {"t": 5, "objects": [{"id": 7, "p": {"x": 1.5}, "tags": ["a", "b"]}, {"id": "8", "p": {"x": "2.5"}}]},
        {"t": 6, "objects": []},
        {"t": 7, "objects": [{"id": 9, "p": {"x": None}, "tags": []}, {"p": None, "tags": ["c"]}, None]},
    )
    assert definition.offers() == {
        "t": "number",
        "objects[].id": "text",
        "objects[].p.x": "text",
        "objects[].tags[]": "text",
    }
    found = shred_messages(definition, payloads, ["t", "objects[].p.x"], ["objects[].id", "objects[].tags[]"])
    assert found.decoded.all()
    assert column(found, "t") == [5, 6, 7]
    assert column(found, "objects[].p.x") == [1.5, 2.5, None, None, None]
    assert column(found, "objects[].id") == ["7", "8", "9", None, None]
    assert column(found, "objects[].tags[]") == ["a", "b", "c"]
    assert found.levels["objects[]"].parent.tolist() == [0, 0, 2, 2, 2]
    assert found.levels["objects[].tags[]"].parent.tolist() == [0, 0, 3]


def test_json_that_is_a_list() -> None:
    definition, payloads = in_json([{"x": 1}, {"x": 2}], [], [{"x": 3}])
    found = shred_messages(definition, payloads, ["[].x", "[1].x"])
    assert column(found, "[].x") == [1, 2, 3]
    assert column(found, "[1].x") == [2, None, None]
    assert found.levels["[]"].parent.tolist() == [0, 0, 2]


def test_lists_in_lists() -> None:
    definition, payloads = in_json({"a": [[1, 2], [], [3]]}, {"a": [[4, 5, 6]]})
    found = shred_messages(definition, payloads, ["a[][]", "a[][1]", "a[0][2]", "a[0][]"])
    assert column(found, "a[][]") == [1, 2, 3, 4, 5, 6]
    assert column(found, "a[][1]") == [2, None, None, 5]
    assert column(found, "a[0][2]") == [None, 6]
    assert column(found, "a[0][]") == [1, 2, 4, 5, 6]
    assert found.levels["a[0][]"].parent.tolist() == [0, 0, 1, 1, 1]


def test_messages_unlike_the_others() -> None:
    good = {"objects": [{"x": 1, "p": {"y": 2}}]}
    definition = JsonDefinition(encoded(good))
    bad = [
        b"",
        b"{",
        b"\xff\xfe",
        b"null",
        b"3",
        b"[" * 100_000,
        b'{"objects": 3}',
        b'{"objects": "text"}',
        b'{"objects": {"x": 1}}',
        b'{"objects": [3]}',
        b'{"objects": [{"p": 3}]}',
        b'{"objects": [{"x": [1]}]}',
        b'{"objects": [{"x": {"y": 1}}]}',
        b'{"objects": [{"x": 1}, {"x": ' + b"9" * 400 + b"}]}",
        b'{"objects": [{"x": ' + b"9" * 5000 + b"}]}",
    ]
    (payload,) = encoded(good)
    mixed = [p for one in bad for p in (one, payload)]
    found = shred_messages(definition, mixed, ["objects[].x", "objects[].p.y"], ["objects[].x"])
    assert found.decoded.tolist() == [False, True] * len(bad)
    assert found.levels[""].parent.tolist() == list(range(1, len(mixed), 2))
    assert found.levels["objects[]"].parent.tolist() == list(range(len(bad)))
    assert column(found, "objects[].p.y") == [2] * len(bad)


def test_values_of_mixed_kinds() -> None:
    values = [1, 2.5, "3", "x", True, None, math.nan, 10**17, -math.inf, 0.1]
    definition, payloads = in_json(*({"v": v} for v in values))
    both = shred_messages(definition, payloads, ["v"], ["v"]).levels[""]
    assert texts(both.texts["v"]) == ["1", "2.5", "3", "x", "true", None, "nan", str(10**17), "-inf", "0.1"]
    np.testing.assert_array_equal(both.numbers["v"], [1, 2.5, 3, np.nan, 1, np.nan, np.nan, 1e17, -np.inf, 0.1])


def test_half_a_surrogate_is_no_text() -> None:
    payloads = [b'{"v": "a\\ud800"}', '{"v": "\U0001f6b2ü"}'.encode()]
    found = shred_messages(JsonDefinition(payloads), payloads, [], ["v"])
    assert column(found, "v") == ["a?", "\U0001f6b2ü"]


def test_what_json_offers() -> None:
    deep: Any = 1
    for _ in range(50):
        deep = {"d": deep}
    definition, _ = in_json({"": 1, "a.b": 1, "c[]": 2, "d": deep, "e": [], "f": {}, "g": None})
    assert definition.offers() == {}
    many, _ = in_json({f"k{k}": k for k in range(30_000)})
    assert len(many.offers()) == 20_000


def test_json_is_judged_by_messages_that_say_something() -> None:
    empty, full = {"objects": []}, {"objects": [{"x": 1}]}
    assert "objects[].x" in JsonDefinition(encoded(*[empty] * 300, full)).offers()
    assert "y" not in JsonDefinition(encoded(*[full] * 20, {"y": 1})).offers()


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text("ab.[]"), inner),
        max_leaves=20,
    ),
    st.data(),
)
def test_any_json(value: Any, data: st.DataObject) -> None:
    payloads = [*encoded(value), b'{"a": 1}', b"[[1]]"]
    definition = JsonDefinition(payloads)
    paths = sorted(definition.offers())
    wanted = data.draw(st.lists(st.sampled_from(paths))) if paths else []
    found = shred_messages(definition, payloads, wanted, paths)
    for name, level in found.levels.items():
        assert found.decoded[found.levels[""].parent[ancestor_rows(found, name, "")]].all()
        for path in level.texts:
            assert len(level.texts[path].code) == len(level.parent)


# ------------------------------------------------------------------------------------------------ items


def oracle(message: Any, path: str) -> list[Any]:
    """Values of a path with items chosen: a row for each item of what is not chosen, None where there is none."""
    parts = [p for part in path.split(".") for p in (part.split("[")[0], *["[" + b for b in part.split("[")[1:]])]
    parts = [p for p in parts if p]
    last = max((k for k, p in enumerate(parts) if p == "[]"), default=-1)
    rows = [message]
    for k, part in enumerate(parts):
        following: list[Any] = []
        for row in rows:
            if part == "[]":
                following += [] if row is None else row
            elif part.startswith("["):
                number = int(part[1:-1])
                there = row is not None and number < len(row)
                if there or k > last:
                    following.append(row[number] if there else None)
            else:
                following.append(None if row is None else row.get(part))
        rows = following
    return rows


@given(st.lists(st.lists(st.lists(st.integers(0, 99), max_size=3), max_size=3), max_size=3), st.data())
def test_one_item_of_a_list(content: list[Any], data: st.DataObject) -> None:
    message = {"a": [{"b": [{"c": c} for c in b]} for b in content]}
    other = {"a": [{"b": [{"c": [5, 6, 7]}]}] * 2}
    steps = [data.draw(st.sampled_from(["[]", "[0]", "[1]", "[2]"])) for _ in range(3)]
    path = "a{}.b{}.c{}".format(*steps)
    definition, payloads = in_json(other, message, other)
    found = shred_messages(definition, payloads, [path])
    assert column(found, path) == [v for m in (other, message, other) for v in oracle(m, path)]
    level = list_level(path)
    of_message = found.levels[""].parent[ancestor_rows(found, level, "")]
    assert of_message.tolist() == [k for k, m in enumerate((other, message, other)) for _ in oracle(m, path)]
    text = f"A[] a\n{SEPARATOR}MSG: p/A2\n"
    text = f"B[] a\n{SEPARATOR}MSG: p/B\nC[] b\n{SEPARATOR}MSG: p/C\nint32[] c"
    in_cdr = shred_messages(defined(text), [serialised(text, m) for m in (other, message, other)], [path])
    assert column(in_cdr, path) == column(found, path)


def test_an_item_and_the_whole_list() -> None:
    definition, payloads = in_json({"a": [{"x": 1, "n": "p"}, {"x": 2, "n": "q"}]})
    found = shred_messages(definition, payloads, ["a[].x", "a[1].x", "a[7].x"], ["a[0].n", "a[].n"])
    assert column(found, "a[].x") == [1, 2]
    assert column(found, "a[1].x") == [2]
    assert column(found, "a[7].x") == [None]
    assert column(found, "a[0].n") == ["p"]


def test_paths_that_are_not_offered() -> None:
    definition, payloads = in_json({"a": [{"x": 1}]})
    for path in ("a[].y", "a[]", "a[0]", "a", "", "a[].x[0]", "a[-1].x", "a[" + "9" * 5000 + "].x"):
        with pytest.raises(KeyError):
            shred_messages(definition, payloads, [path])
        with pytest.raises(KeyError):
            shred_messages(definition, payloads, [], [path])


# ------------------------------------------------------------------------------------------------ protobuf

OBJECTS = schema(
    "q",
    {
        "List": "uint64 t\nrepeated Object objects\nrepeated Kind kinds",
        "Object": "string id\nPlace place\noptional double speed\nKind kind\nbytes raw\nbool seen\nfloat length",
        "Place": "double x\ndouble y",
    },
    {"Kind": {"UNKNOWN": 0, "CAR": 1, "PERSON": 7}},
)


def test_protobuf() -> None:
    definition, payload = in_protobuf(OBJECTS, "List")
    assert definition.offers() == {
        "t": "number",
        "kinds[]": "number",
        "objects[].id": "text",
        "objects[].speed": "number",
        "objects[].kind": "number",
        "objects[].raw": "text",
        "objects[].seen": "number",
        "objects[].length": "number",
        "objects[].place.x": "number",
        "objects[].place.y": "number",
    }
    first = {"id": "a", "place": {"x": 1.5}, "speed": 0, "kind": "CAR", "raw": "AP8=", "seen": True, "length": 0.1}
    messages = [{"t": str(2**63 + 1), "objects": [first, {"kind": 5}], "kinds": ["PERSON", "CAR"]}, {}]
    numbers = [p for p in definition.offers() if p != "objects[].id"]
    found = shred_messages(definition, [payload(m) for m in messages], numbers, ["t", "objects[].raw"])
    assert column(found, "objects[].speed") == [0, None]  # optional: 0 is said, or it is not
    assert column(found, "objects[].place.x") == [1.5, None]
    assert column(found, "objects[].place.y") == [0, None]
    assert column(found, "objects[].kind") == [1, 5]
    assert column(found, "objects[].seen") == [1, 0]
    assert texts(found.levels[""].texts["t"]) == [str(2**63 + 1), "0"]
    assert texts(found.levels["objects[]"].texts["objects[].raw"]) == ["00ff", ""]
    named = shred_messages(
        definition, [payload(m) for m in messages], [], ["objects[].kind", "kinds[]", "objects[].seen"]
    )
    assert column(named, "objects[].kind") == ["CAR", "5"]
    assert column(named, "kinds[]") == ["PERSON", "CAR"]
    assert column(named, "objects[].seen") == ["true", "false"]


def test_damaged_protobuf() -> None:
    definition, payload = in_protobuf(OBJECTS, "List")
    good = payload({"t": "3", "objects": [{"id": "a"}]})
    found = shred_messages(definition, [good, b"\xff\xff\xff", good[:-1], b"", good], ["t"], ["objects[].id"])
    assert found.decoded.tolist() == [True, False, False, True, True]
    assert column(found, "objects[].id") == ["a", "a"]


def test_maps_are_left_out() -> None:
    file = schema("m", {"A": "double x"})
    entry = file.message_type[0].nested_type.add(name="TagsEntry")
    entry.field.add(name="key", number=1, label=1, type=Kinds.TYPE_STRING)
    entry.field.add(name="value", number=2, label=1, type=Kinds.TYPE_STRING)
    entry.options.map_entry = True
    file.message_type[0].field.add(name="tags", number=2, label=3, type=Kinds.TYPE_MESSAGE, type_name=".m.A.TagsEntry")
    definition, payload = in_protobuf(file, "A")
    assert definition.offers() == {"x": "number"}
    assert column(shred_messages(definition, [payload({"x": 2, "tags": {"a": "b"}})], ["x"]), "x") == [2]


def test_definitions_that_refer_to_themselves() -> None:
    file = schema("r", {"A": "double x\nrepeated A children"})
    definition, payload = in_protobuf(file, "A")
    assert len(definition.offers()) == 12
    path = "children[].children[].x"
    found = shred_messages(definition, [payload({"x": 1, "children": [{"x": 2, "children": [{"x": 3}]}]})], [path])
    assert column(found, path) == [3]
    many, _ = in_protobuf(schema("r", {"A": "double x\n" + "\n".join(f"A a{k}" for k in range(30))}), "A")
    assert {"x", "a29.x", "a3.a4.x"} <= set(many.offers())
    assert len(many.offers()) < 40_000


@pytest.mark.parametrize("data", [b"", b"\xff\xff", b"\x0a\x02\x0a\x00", b"no descriptors at all"])
def test_descriptors_that_are_none(data: bytes) -> None:
    with pytest.raises(DefinitionError, match=r"the definition of q\.A cannot be used"):
        ProtobufDefinition("q.A", SimpleNamespace(id=1, name="q.A", encoding="protobuf", data=data))


def test_a_schema_of_another_encoding() -> None:
    with pytest.raises(DefinitionError, match="not one of protobuf"):
        ProtobufDefinition("q.A", SimpleNamespace(id=1, name="q.A", encoding="ros2msg", data=b""))


@given(st.binary(max_size=60))
def test_any_bytes_as_protobuf(payload: bytes) -> None:
    definition, _ = in_protobuf(OBJECTS, "List")
    shred_messages(definition, [payload], ["objects[].place.x", "t"], list(definition.offers()))


# ------------------------------------------------------------------------------------------------ three encodings


THING = st.fixed_dictionaries(
    {
        "name": st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=5),
        "x": st.floats(allow_nan=False, allow_infinity=False),
        "f": st.floats(width=32, allow_nan=False, allow_infinity=False),
        "n": st.integers(-(2**63), 2**63 - 1),
        "yes": st.booleans(),
        "v": st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=3),
    }
)


@given(st.lists(st.lists(THING, max_size=3), min_size=1, max_size=3))
def test_the_same_content_gives_the_same_columns(content: Sequence[list[dict[str, Any]]]) -> None:
    messages = [{"t": k, "things": things} for k, things in enumerate(content)]
    fields = "string name\nfloat64 x\nfloat32 f\nint64 n\nbool yes\nfloat64[] v"
    text = f"int32 t\nThing[] things\n{SEPARATOR}MSG: p/Thing\n{fields}"
    file = schema(
        "s",
        {
            "A": "int32 t\nrepeated Thing things",
            "Thing": "string name\ndouble x\nfloat f\nint64 n\nbool yes\nrepeated double v",
        },
    )
    protobuf, payload = in_protobuf(file, "A")
    whole = {"t": 9, "things": [{"name": "", "x": 0.5, "f": 0.5, "n": 1, "yes": True, "v": [0.5]}]}
    made: dict[str, tuple[Definition, list[bytes]]] = {
        "json": (JsonDefinition(encoded(whole)), encoded(*messages)),
        "protobuf": (protobuf, [payload(m) for m in messages]),
        "cdr": (defined(text), [serialised(text, m) for m in messages]),
    }
    numbers = ["t", "things[].x", "things[].f", "things[].n", "things[].yes", "things[].v[]", "things[].v[1]"]
    said = ["things[].name", "things[].n", "things[].x", "things[].f", "things[].yes", "things[1].name"]
    found = {name: shred_messages(*one, numbers, said) for name, one in made.items()}
    offers = [definition.offers() for definition, _ in made.values()]
    assert offers[0] == offers[1] == offers[2]
    for other in ("protobuf", "cdr"):
        for name, level in found["json"].levels.items():
            same_level(level, found[other].levels[name])


def same_level(one: LevelRows, other: LevelRows) -> None:
    np.testing.assert_array_equal(one.parent, other.parent)
    assert one.numbers.keys() == other.numbers.keys()
    assert one.texts.keys() == other.texts.keys()
    for path in one.numbers:
        np.testing.assert_array_equal(one.numbers[path], other.numbers[path])
    for path in one.texts:
        assert texts(one.texts[path]) == texts(other.texts[path])


def test_single_precision_is_the_same_text() -> None:
    """Of a float32 the number is said that it is, not the one it was meant for."""
    text = "float32 f"
    in_cdr = shred_messages(defined(text), [serialised(text, {"f": 0.1})], ["f"], ["f"])
    definition, payload = in_protobuf(schema("f", {"A": "float f"}), "A")
    in_proto = shred_messages(definition, [payload({"f": 0.1})], ["f"], ["f"])
    exact = struct.unpack("<f", struct.pack("<f", 0.1))[0]
    assert in_cdr.levels[""].numbers["f"].tolist() == in_proto.levels[""].numbers["f"].tolist() == [exact]
    assert column(in_cdr, "f") == column(in_proto, "f")
