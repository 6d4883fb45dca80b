"""ROS 2 messages taken apart: against rosbags, which serialised them, and mcap-ros2-support."""

import math
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from copem_replay.io.channel import DefinitionError
from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.encodings.columns import (
    ShreddedMessages,
    ancestor_rows,
    list_level,
    shred_messages,
)
from tests.helpers.messages import SEPARATOR, defined, serialised, texts

NUSCENES = Path(__file__).parents[3] / "shared/data/nuscenes_scene0916_autoware_ros2.mcap"
NUMBERS = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}


def walk(value: Any, path: str) -> list[Any]:
    """All values at a path, by plain recursion: the oracle of `shred`."""
    values = [value]
    for part in path.split("."):
        name, lists = part.split("[")[0], part.count("[]")
        values = [v[name] for v in values]
        for _ in range(lists):
            values = [item for v in values for item in v]
    return values


def same(found: np.ndarray, expected: list[Any]) -> None:
    np.testing.assert_array_equal(found, np.array([float(v) for v in expected]))


# ------------------------------------------------------------------------------------------------ values by hand


def test_numbers_of_every_kind_are_aligned_to_their_size() -> None:
    lines, message = [], {}
    for k, kind in enumerate(NUMBERS):  # a byte before each: every number has to be aligned
        lines += [f"uint8 before{k}", f"{kind} v{k}"]
        message |= {f"before{k}": k, f"v{k}": 1 if kind == "bool" else k + 0.5 if "float" in kind else k + 1}
    text = "\n".join(lines)
    for little in (True, False):
        found = shred_messages(defined(text), [serialised(text, message, little=little)] * 2, list(message))
        assert found.decoded.all()
        for name, value in message.items():
            assert found.levels[""].numbers[name].tolist() == [value, value], name


def test_least_and_most() -> None:
    text = "int8 a\nint64 b\nuint64 c\nfloat64 d\nfloat32 e"
    message = {"a": -128, "b": -(2**63), "c": 2**64 - 1, "d": math.nan, "e": -math.inf}
    level = shred_messages(defined(text), [serialised(text, message)], "abcde", "abcde").levels[""]
    assert [level.numbers[n][0] for n in "abce"] == [-128, -(2.0**63), 2.0**64, -math.inf]
    assert np.isnan(level.numbers["d"][0])
    assert [texts(level.texts[n])[0] for n in "abcde"] == ["-128", str(-(2**63)), str(2**64 - 1), "nan", "-inf"]


def test_texts_and_numbers_as_texts() -> None:
    text = "bool a\nstring b\nstring<=9 c\nfloat64 d\nfloat64 e\nbyte[3] f\nuint8[] g\nstring h"
    message = {"a": True, "b": "Fußgänger", "c": "", "d": 1533151603.123456, "e": 7.0, "h": "12.5"}
    message |= {"f": [0, 255, 16], "g": [1, 2]}
    found = shred_messages(defined(text), [serialised(text, message)], ["a", "b", "h", "f"], "abcdefgh").levels[""]
    assert [texts(found.texts[n])[0] for n in "abcdefgh"] == [
        "true",
        "Fußgänger",
        "",
        "1533151603.123456",
        "7",
        "00ff10",
        "0102",
        "12.5",
    ]
    assert found.numbers["h"][0] == 12.5  # MSight writes numbers as texts
    assert np.isnan([found.numbers["b"][0], found.numbers["f"][0]]).all()


def test_each_distinct_text_is_kept_once() -> None:
    definition = defined("string a")
    said = [b"car\0", b"car", b"bus\0", b"\xff\0", b"\xfe\0"]
    payloads = [b"\0\1\0\0" + struct.pack("<I", len(s)) + s for s in said]
    column = shred_messages(definition, payloads, texts=["a"]).levels[""].texts["a"]
    assert texts(column) == ["car", "car", "bus", "�", "�"]
    assert len(set(column.words)) == len(column.words) == 3


def test_an_id_as_text_its_items_and_one_of_them_at_once() -> None:
    text = "uint16 before\nuint8[4] id\nfloat64 after\nuint8[] more\nuint32 last"
    message = {"before": 1, "id": [1, 2, 3, 4], "after": 2.5, "more": [9, 8], "last": 77}
    payload = serialised(text, message)
    paths = ["id[]", "id[2]", "after", "more[]", "more[1]", "last"]
    found = shred_messages(defined(text), [payload, payload], paths, ["id", "more"])
    assert texts(found.levels[""].texts["id"]) == ["01020304"] * 2
    assert texts(found.levels[""].texts["more"]) == ["0908"] * 2
    assert found.levels["id[]"].numbers["id[]"].tolist() == [1, 2, 3, 4] * 2
    assert found.levels["more[]"].numbers["more[]"].tolist() == [9, 8] * 2
    for path, value in {"id[2]": 3, "after": 2.5, "more[1]": 8, "last": 77}.items():
        assert found.levels[""].numbers[path].tolist() == [value, value], path


def test_items_of_lists_of_numbers() -> None:
    text = "B[] b\n" + SEPARATOR + "MSG: p/B\nuint8 x\nfloat64[9] c\nfloat32[] d\nint16[3] e"
    rows = [
        {"x": 1, "c": range(9), "d": [0.5], "e": [7, 8, 9]},
        {"x": 2, "c": range(10, 19), "d": [], "e": [-7, -8, -9]},
    ]
    paths = ["b[].c[8]", "b[].c[0]", "b[].c[7]", "b[].d[0]", "b[].e[1]", "b[].x", "b[].c[9]", "b[1].x", "b[0].c[3]"]
    found = shred_messages(defined(text), [serialised(text, {"b": rows})], paths)
    level = found.levels["b[]"].numbers
    assert level["b[].c[8]"].tolist() == [8, 18]
    assert level["b[].c[0]"].tolist() == [0, 10]
    assert level["b[].c[7]"].tolist() == [7, 17]
    assert level["b[].e[1]"].tolist() == [8, -8]
    assert level["b[].x"].tolist() == [1, 2]
    np.testing.assert_array_equal(level["b[].d[0]"], [0.5, np.nan])
    assert np.isnan(level["b[].c[9]"]).all()  # there are nine
    assert found.levels[""].numbers["b[1].x"].tolist() == [2]
    assert found.levels[""].numbers["b[0].c[3]"].tolist() == [3]


def test_an_empty_structure_is_a_byte() -> None:
    text = "E e\nE[2] f\nE[] g\nuint8 x\n" + SEPARATOR + "MSG: p/E\n"
    payload = b"\0\1\0\0" + bytes(1 + 2 + 1) + struct.pack("<I", 3) + bytes(3) + b"\x2a"
    found = shred_messages(defined(text), [payload], ["x"])
    assert found.decoded.all()
    assert found.levels[""].numbers["x"].tolist() == [42]


def test_xcdr2() -> None:
    """DDS-XTypes 1.3, 7.4.3: eight bytes are aligned to four; lists of what is no number are preceded by their size."""
    text = "uint8 a\nfloat64 b\nstring[] c\nfloat64[] d\nB[2] e\n" + SEPARATOR + "MSG: p/B\nuint8 x\nint64 y"
    for order, ident in (("<", 7), (">", 6)):
        body = struct.pack(order + "B3xd", 1, 2.5)
        names = struct.pack(order + "II2sxx", 1, 2, b"n\0")[:-2]
        body += struct.pack(order + "I", len(names)) + names + bytes(2)
        body += struct.pack(order + "Id", 1, 3.5)
        items = struct.pack(order + "B3xqB3xq", 4, -4, 5, -5)
        body += struct.pack(order + "I", len(items)) + items
        paths = ["a", "b", "d[]", "e[].x", "e[].y"]
        found = shred_messages(defined(text), [bytes([0, ident, 0, 0]) + body], paths, ["c[]"])
        assert found.decoded.all()
        assert [found.levels[""].numbers[n].tolist() for n in "ab"] == [[1], [2.5]]
        assert texts(found.levels["c[]"].texts["c[]"]) == ["n"]
        assert found.levels["d[]"].numbers["d[]"].tolist() == [3.5]
        assert found.levels["e[]"].numbers["e[].x"].tolist() == [4, 5]
        assert found.levels["e[]"].numbers["e[].y"].tolist() == [-4, -5]


def test_definitions_as_they_are_written() -> None:
    text = (
        "# what it is\r\nuint8 A=1 # a constant\r\nstring B = hello\r\nint32[<=3] few\r\nstd_msgs/Header header\r\n"
        "string name 'x'\r\n==========================================\r\nMSG: std_msgs/Header\r\n"
        "builtin_interfaces/Time stamp\r\nstring frame_id"
    )  # the time stamp is often left out by writers in Python
    definition = defined(text)
    assert definition.offers() == {
        "few[]": "number",
        "header.stamp.sec": "number",
        "header.stamp.nanosec": "number",
        "header.frame_id": "text",
        "name": "text",
    }


def test_idl() -> None:
    text = (
        SEPARATOR
        + "IDL: p/msg/A\n"
        + '#include "p/msg/B.idl"\nmodule p { module msg {\n typedef double double__3[3];\n'
        + " module A_Constants { const uint8 CAR = 1; };\n"
        + ' @verbatim (language="comment", text="what it is")\n'
        + " struct A { octet o; p::msg::B b; sequence<p::msg::B, 4> bs; double__3 v;\n"
        + " @default (value=TRUE) boolean yes; unsigned long u; string<8> s; float f; uint8 k; }; }; };\n"
        + SEPARATOR
        + "IDL: p/msg/B\nmodule p { module msg { struct B { long long x; char c; }; }; };\n"
    )
    same_in_msg = "byte o\nB b\nB[<=4] bs\nfloat64[3] v\nbool yes\nuint32 u\nstring<=8 s\nfloat32 f\nuint8 k\n"
    same_in_msg += SEPARATOR + "MSG: p/B\nint64 x\nchar c"
    b = {"x": -3, "c": 65}
    message = {"o": 1, "b": b, "bs": [b, b], "v": [1, 2, 3], "yes": True, "u": 9, "s": "t", "f": 0.5, "k": 2}
    definition = defined(text, encoding="ros2idl")
    assert definition.offers() == defined(same_in_msg).offers()
    found = shred_messages(
        definition, [serialised(same_in_msg, message)], ["o", "b.x", "bs[].c", "v[2]", "yes", "u"], ["s"]
    )
    assert found.decoded.all()
    level = found.levels[""].numbers
    assert [level[n][0] for n in ("o", "b.x", "v[2]", "yes", "u")] == [1, -3, 3, 1, 9]
    assert found.levels["bs[]"].numbers["bs[].c"].tolist() == [65, 65]


# ------------------------------------------------------------------------------------------------ against rosbags


@dataclass
class Made:
    """A definition and messages of it."""

    text: str
    messages: list[dict[str, Any]]
    paths: dict[str, str] = field(default_factory=dict)


@st.composite
def definitions(draw: st.DrawFn) -> Made:
    """Structures A … of fields of every kind; later ones are used in earlier ones."""
    number = draw(st.integers(1, 4))
    names = "ABCD"[:number]
    layout: dict[str, list[tuple[str, str, str, int]]] = {}
    for k, name in enumerate(names):
        layout[name] = []
        inner = list(names[k + 1 :])
        least = 0 if k else 1
        for f in range(draw(st.integers(least, 5))):
            kind = draw(st.sampled_from([*NUMBERS, "string", "string", *inner, *inner, *inner]))
            form = draw(st.sampled_from(["", "", "array", "list", "bounded"]))
            layout[name].append((f"f{f}", kind, form, draw(st.integers(1, 3))))

    def value(kind: str) -> Any:
        if kind in layout:
            return {f: listed(inner, form, n) for f, inner, form, n in layout[kind]}
        if kind == "string":
            return draw(st.sampled_from(["", "a", "ab", "abc", "Straße", "日本"]))
        if kind == "bool":
            return draw(st.booleans())
        if kind.startswith("float"):
            return draw(st.floats(width=32))
        size = 7 if kind == "byte" else struct.calcsize(NUMBERS[kind]) * 8  # rosbags writes single bytes with a sign
        return draw(
            st.integers(-(2 ** (size - 1)), 2 ** (size - 1) - 1)
            if kind.startswith("int")
            else st.integers(0, 2**size - 1)
        )

    def listed(kind: str, form: str, n: int) -> Any:
        if not form:
            return value(kind)
        return [value(kind) for _ in range(n if form == "array" else draw(st.integers(0, n)))]

    ends = {"": "", "array": "[{}]", "list": "[]", "bounded": "[<={}]"}
    parts = [
        (f"MSG: p/{name}\n" if k else "")
        + "".join(f"{kind}{ends[form].format(n)} {f}\n" for f, kind, form, n in fields)
        for k, (name, fields) in enumerate(layout.items())
    ]
    return Made(SEPARATOR.join(parts), [value("A") for _ in range(draw(st.integers(1, 4)))])


def check(definition: CdrDefinition, made: list[dict[str, Any]], found: ShreddedMessages, paths: list[str]) -> None:
    """All values are those that were serialised, and all rows have their parents."""
    for path in paths:
        level = list_level(path)
        expected = [v for m in made for v in walk(m, path)]
        of_message = [k for k, m in enumerate(made) for _ in walk(m, path)]
        column = found.levels[level]
        assert found.levels[""].parent[ancestor_rows(found, level, "")].tolist() == of_message
        if definition.offers()[path] == "number":
            same(column.numbers[path], expected)
        elif all(isinstance(v, str) for v in expected):
            assert texts(column.texts[path]) == expected
        else:
            assert texts(column.texts[path]) == [bytes(v).hex() for v in expected]


@given(definitions(), st.booleans(), st.data())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_what_was_serialised_is_found(made: Made, little: bool, data: st.DataObject) -> None:
    definition = defined(made.text)
    payloads = [serialised(made.text, m, little=little) for m in made.messages]
    offered = definition.offers()
    if not offered:
        return
    wanted = data.draw(st.lists(st.sampled_from(sorted(offered)), min_size=1, unique=True))
    for paths in (list(offered), wanted):
        numbers, said = [p for p in paths if offered[p] == "number"], [p for p in paths if offered[p] == "text"]
        found = shred_messages(definition, payloads, numbers, said)
        assert found.decoded.all()
        check(definition, made.messages, found, paths)


@given(definitions(), st.data())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_damaged_messages_are_told_and_the_others_unharmed(made: Made, data: st.DataObject) -> None:
    definition = defined(made.text)
    payloads = [serialised(made.text, m) for m in made.messages]
    offered = definition.offers()
    if not offered:
        return
    whole = data.draw(st.sampled_from(payloads))
    flipped = bytearray(whole)
    flipped[data.draw(st.integers(0, len(whole) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    bad = data.draw(st.sampled_from([whole[:-9], whole[:3], b"", bytes(flipped), b"\0\1\0\0" + b"\xff" * 40]))
    bad = data.draw(st.sampled_from([bad, data.draw(st.binary(max_size=64)), whole + bytes(9)]))
    numbers = [p for p in offered if offered[p] == "number"]
    said = [p for p in offered if offered[p] == "text"]
    alone, mixed = (shred_messages(definition, p, numbers, said) for p in (payloads, [bad, *payloads, bad]))
    assert mixed.decoded[1:-1].all()
    assert mixed.decoded[0] == mixed.decoded[-1]
    for name, level in alone.levels.items():
        message = mixed.levels[""].parent[ancestor_rows(mixed, name, "")]
        good = (message > 0) & (message <= len(payloads))
        if not mixed.decoded[0]:
            assert good.all()
        for path, column in level.numbers.items():
            np.testing.assert_array_equal(mixed.levels[name].numbers[path][good], column)
        for path, words in level.texts.items():
            assert [w for w, g in zip(texts(mixed.levels[name].texts[path]), good, strict=True) if g] == texts(words)


def test_batches_of_messages_are_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "string n\nB[] b\n" + SEPARATOR + "MSG: p/B\nfloat64 x\nstring[] s"
    made = [{"n": str(k % 3), "b": [{"x": k + j / 10, "s": [f"{k}-{j}"] * j} for j in range(k % 4)]} for k in range(20)]
    payloads = [serialised(text, m) for m in made]
    payloads.insert(7, b"\0\1\0\0")
    one = shred_messages(defined(text), payloads, ["b[].x"], ["n", "b[].s[]"])
    monkeypatch.setattr("copem_replay.io.encodings.columns.BATCH_BYTES", 60)
    many = shred_messages(defined(text), payloads, ["b[].x"], ["n", "b[].s[]"])
    assert one.decoded.tolist() == many.decoded.tolist() == [k != 7 for k in range(21)]
    for name, level in one.levels.items():
        assert level.parent.tolist() == many.levels[name].parent.tolist()
        for path, column in level.numbers.items():
            np.testing.assert_array_equal(many.levels[name].numbers[path], column)
        for path, words in level.texts.items():
            assert texts(many.levels[name].texts[path]) == texts(words)


# ------------------------------------------------------------------------------------------------ hostile


def test_lengths_that_cannot_be() -> None:
    text = "B[] b\nfloat64[] c\nstring d\n" + SEPARATOR + "MSG: p/B\nB2[] x\n" + SEPARATOR + "MSG: p/B2\nuint8 z"
    definition = defined(text)
    for payload in (
        b"\0\1\0\0" + b"\xff" * 4,
        b"\0\1\0\0" + b"\xff" * 400,
        b"\0\1\0\0" + struct.pack("<II", 0, 2**32 - 1) + bytes(100),
        b"\0\1\0\0" + struct.pack("<III", 0, 0, 2**32 - 1) + bytes(100),
        b"\0\1\0\0" + struct.pack("<I", 1000) + bytes(1200),
    ):
        found = shred_messages(definition, [payload], ["b[].x[].z", "c[]"], ["d"])
        assert not found.decoded.any()
        assert all(len(level.parent) == 0 for level in found.levels.values())


def test_no_messages() -> None:
    found = shred_messages(defined("B[] b\n" + SEPARATOR + "MSG: p/B\nuint8 z\nstring s"), [], ["b[].z"], ["b[].s"])
    assert found.levels["b[]"].numbers["b[].z"].tolist() == []
    assert texts(found.levels["b[]"].texts["b[].s"]) == []


def test_wide_texts_are_not_read() -> None:
    with pytest.raises(DefinitionError, match="wstring"):
        defined("uint8 a\nwstring b")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("A again", "nested without end"),
        ("B b\n" + SEPARATOR + "MSG: p/B\nA a", "nested without end"),
        ("B b", "lacks p/msg/B"),
        ("wchar a", "wchar"),
        ("uint8[0] a", "array of 0"),
        ("uint8[-5] a", "array of -5"),
        ("B[99999999999] a\n" + SEPARATOR + "MSG: p/B\nuint8 x", "array of 99999999999"),
        ("no = definition", "cannot be parsed"),
        ("\x00\x01", "cannot be parsed"),
        ("", "the recorder lacked the package of p/msg/A"),
        (
            "".join(f"B{k + 1} a\nB{k + 1} b\n{SEPARATOR}MSG: p/B{k + 1}\n" for k in range(40)),
            "nested without end|more than",
        ),
        (
            "".join(f"B{k + 1} a\nB{k + 1} b\n{SEPARATOR}MSG: p/B{k + 1}\n" for k in range(25)),
            "more than",
        ),
    ],
)
def test_definitions_that_cannot_be_used(text: str, told: str) -> None:
    with pytest.raises(DefinitionError, match=told):
        defined(text)


@given(st.one_of(st.binary(max_size=80), st.text(alphabet="AB abuint8[]<=1\n#:{};", max_size=80).map(str.encode)))
def test_anything_as_a_definition(text: bytes) -> None:
    for encoding in ("ros2msg", "ros2idl"):
        try:
            definition = CdrDefinition("p/msg/A", encoding, text)
        except DefinitionError:
            continue
        shred_messages(definition, [b"", b"\0\1\0\0" + bytes(40)], [], list(definition.offers()))


def test_a_constant_of_gigabytes() -> None:
    text = "module p { module msg { const uint64 X = 1 << 99999999999; struct A { octet o; }; }; };"
    with pytest.raises(DefinitionError, match="shifted by 99999999999"):
        defined(text, encoding="ros2idl")


@pytest.mark.parametrize("name", ["", "A", "p/A\nuint8 x"])
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(DefinitionError):
        CdrDefinition(name, "ros2msg", b"uint8 q")


def test_lists_as_deep_as_they_may_be() -> None:
    text = "".join(f"B{k + 1}[] a\n{SEPARATOR}MSG: p/B{k + 1}\n" for k in range(30)) + "string[] s"
    definition = defined(text)
    (path,) = definition.offers()
    payload = b"\0\1\0\0" + struct.pack("<I", 1) * 31 + struct.pack("<I", 2) + b"x\0"
    found = shred_messages(definition, [payload], [], [path])
    assert found.decoded.all()
    assert texts(found.levels[list_level(path)].texts[path]) == ["x"]
    assert not shred_messages(definition, [b"\0\1\0\0" + b"\2\0\0\0" * 40], [], [path]).decoded.any()


def test_a_path_that_is_not_there() -> None:
    for path in ("b", "a.x", "a[]", "a[0]", "", "[]", "a]"):
        with pytest.raises(KeyError):
            shred_messages(defined("uint8 a"), [], [path])


# ------------------------------------------------------------------------------------------------ a real recording


@pytest.mark.skipif(not NUSCENES.exists(), reason=f"{NUSCENES} is not here")
def test_a_recording_against_mcap_ros2_support() -> None:
    decoder = pytest.importorskip("mcap_ros2._dynamic")
    from mcap.reader import make_reader

    with NUSCENES.open("rb") as file:
        records = [(schema, message.data) for schema, _, message in make_reader(file).iter_messages()]
    for name in {schema.name for schema, _ in records}:
        schema = next(s for s, _ in records if s.name == name)
        payloads = [data for s, data in records if s.name == name][::5]
        decoded = [decoder.generate_dynamic(name, schema.data.decode())[name](p) for p in payloads]
        definition = CdrDefinition(name, schema.encoding, schema.data)
        offers = definition.offers()
        numbers = [p for p, kind in offers.items() if kind == "number"]
        said = [p for p, kind in offers.items() if kind == "text"]
        found = shred_messages(definition, payloads, numbers, said)
        assert found.decoded.all()
        assert len(offers) > 10
        for path in offers:
            expected = [v for m in decoded for v in walk_objects(m, path)]
            level = found.levels[list_level(path)]
            if path in numbers:
                same(level.numbers[path], expected)
            else:
                assert texts(level.texts[path]) == [v if isinstance(v, str) else bytes(v).hex() for v in expected]


def walk_objects(value: Any, path: str) -> list[Any]:
    values = [value]
    for part in path.split("."):
        values = [getattr(v, part.split("[")[0]) for v in values]
        for _ in range(part.count("[]")):
            values = [item for v in values for item in v]
    return values
