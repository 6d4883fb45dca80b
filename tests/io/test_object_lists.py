"""Object lists read by the names of their fields: every option, computed in the head."""

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from copem_replay.core.tracks import CLASSES, VALUES
from copem_replay.io.encodings.json import JsonDefinition
from copem_replay.io.schemas.object_lists import (
    ClassField,
    DecodedLists,
    Description,
    Fields,
    FieldsError,
    Stamp,
    Yaw,
    decode_lists,
)
from tests.helpers.messages import SEPARATOR, classes, defined, ids, quaternion, serialised, values
from tests.io.test_columns import OBJECTS, in_protobuf

LEAST: dict[str, Any] = {"objects": "o[]", "x_m": "x", "y_m": "y", "length_m": 4.5, "width_m": 2}
OBJECT: dict[str, Any] = {"x": 1.0, "y": 2.0}


def read(fields: dict[str, Any], *messages: Any, logged: list[int] | None = None, **more: Any) -> DecodedLists:
    payloads = [m if isinstance(m, bytes) else json.dumps(m).encode() for m in messages]
    description = Description(Fields.model_validate({**LEAST, **fields}), **more)
    times = np.array(logged or [1000 + k for k in range(len(payloads))], dtype=np.int64)
    return decode_lists(JsonDefinition(payloads), description, payloads, times)


def noted(found: DecodedLists) -> tuple[str, ...]:
    """Its notes, but that messages have no time stamp."""
    return tuple(note for note in found.columns.notes if "without timestamp" not in note)


def one(fields: dict[str, Any], *objects: dict[str, Any], **more: Any) -> DecodedLists:
    """Of a single message with these objects."""
    return read(fields, {"o": [{**OBJECT, **o} for o in objects or ({},)]}, **more)


# ------------------------------------------------------------------------------------ values


def test_the_least_that_is_said() -> None:
    found = read({}, {"o": [OBJECT, {"x": 3, "y": None}]}, {"o": []}, {"o": [OBJECT]})
    columns = found.columns
    assert columns.rows.tolist() == [2, 0, 1]
    assert columns.stamp_ns.tolist() == [1000, 1001, 1002] == found.columns.log_time_ns.tolist()
    assert not columns.stamped.any()
    assert columns.values.tolist()[0][:4] == [1, 2, 0, 0]
    assert [values(found, n)[1] for n in VALUES] == [3, None, 0, 0, None, None, 4.5, 2, 0]
    assert classes(found) == ["other"] * 3
    assert len(set(ids(found))) == 3  # without ids each is an object of its own
    assert columns.moving.all()
    assert found.frame_code.tolist() == [-1] * 3
    assert np.isnan(found.existence).all()
    assert np.isnan(found.covariance_m2).all()
    assert found.probability.sum(axis=1).tolist() == [1, 1, 1]
    assert noted(found) == ()


def test_paths_of_everything() -> None:
    keys = {"z_m": "z", "length_m": "d.l", "width_m": "d.w", "height_m": "d.h", "vx_mps": "v[0]", "vy_mps": "v[1]"}
    said = {"z": -1.5, "d": {"l": 4, "w": "1.9", "h": 1.6}, "v": [3, 4], "a": 0.25, "e": 0.75}
    found = one({**keys, "yaw_rad": "a", "existence": "e"}, said, {"z": 1, "v": [1]})
    assert [values(found, n)[0] for n in VALUES] == [1, 2, -1.5, 0.25, 3, 4, 4, 1.9, 1.6]
    assert [values(found, n)[1] for n in VALUES] == [1, 2, 1, None, 1, None, None, None, None]
    assert found.existence.tolist()[0] == 0.75


def test_values_of_the_message_go_for_all_its_objects() -> None:
    found = read({"z_m": "/ground.z"}, {"ground": {"z": 7}, "o": [OBJECT, OBJECT]}, {"ground": {"z": 8}, "o": [OBJECT]})
    assert values(found, "z_m") == [7, 7, 8]


def test_objects_of_one_sensor() -> None:
    sensors = [{"name": "front", "o": [OBJECT, OBJECT]}, {"name": "rear", "o": [{"x": 9, "y": 9}]}]
    message = {"sensors": sensors}
    found = read({"objects": "sensors[1].o[]", "frame": "sensors[1].name"}, message, message)
    assert values(found, "x_m") == [9, 9]
    assert found.columns.rows.tolist() == [1, 1]
    assert [found.frames[k] for k in found.frame_code] == ["rear", "rear"]
    every = read({"objects": "sensors[].o[]", "frame": "sensors[].name"}, message)
    assert [every.frames[k] for k in every.frame_code] == ["front", "front", "rear"]


def test_headings() -> None:
    yaws = [0.0, 0.5, -2.0, 3.0]
    assert values(one({"yaw_rad": {"degrees": "a"}}, {"a": 180}, {"a": -90}), "yaw_rad") == [math.pi, -math.pi / 2]
    assert values(one({"yaw_rad": 0.3}, {}), "yaw_rad") == [0.3]
    for scale in (1.0, -1.0, 3.0, 1e-3):  # a quaternion of another length points the same way
        found = one({"yaw_rad": {"quaternion": "q"}}, *({"q": quaternion(yaw, scale)} for yaw in yaws))
        assert values(found, "yaw_rad") == yaws
    # rolled by 180°, it still looks along +x; pitched by 60° about y, too
    tilted = [{"x": 1, "y": 0, "z": 0, "w": 0}, {"x": 0, "y": 0.5, "z": 0, "w": math.sqrt(0.75)}]
    assert values(one({"yaw_rad": {"quaternion": "q"}}, *({"q": q} for q in tilted)), "yaw_rad") == [0, 0]


def test_a_quaternion_of_zeros() -> None:
    nothing = {"x": 0, "y": 0, "z": 0, "w": 0}
    found = one({"yaw_rad": {"quaternion": "q"}}, {"q": nothing}, {"q": quaternion(1)}, {"q": None})
    assert values(found, "yaw_rad") == [0, 1, None]
    assert noted(found) == ("1 object state without orientation: yaw 0 taken",)


def test_velocity_along_the_object() -> None:
    keys = {"vx_mps": "v.x", "vy_mps": "v.y", "yaw_rad": "a"}
    moving = {"v": {"x": 10, "y": 1}, "a": math.pi / 2}
    assert [values(one(keys, moving), n) for n in ("vx_mps", "vy_mps")] == [[10], [1]]
    along = one({**keys, "velocity": "object"}, moving)
    assert [values(along, n) for n in ("vx_mps", "vy_mps")] == [[-1], [10]]


def test_covariance() -> None:
    matrix = [[100 * r + c for c in range(6)] for r in range(6)]
    flat = [v for row in matrix for v in row]
    found = one({"covariance": "c"}, {"c": flat}, {"c": []})
    np.testing.assert_array_equal(found.covariance_m2, [[0, 1, 101], [np.nan] * 3])


# ------------------------------------------------------------------------------------ classes


def test_class_names() -> None:
    found = one({"class": "c"}, *({"c": c} for c in ("Pedestrian", "vehicle.bus.rigid", "TYPE_CAR", "?", None, 3, "")))
    assert classes(found) == ["pedestrian", "bus", "car", "other", "other", "other", "other"]


def test_class_map() -> None:
    mapped = {"path": "c", "map": {1: "car", "seven": "pedestrian", "truck": "other"}}
    found = one({"class": mapped}, *({"c": c} for c in (1, "1", 1.0, "seven", "truck", "bus", 2)))
    assert classes(found) == ["car", "car", "car", "pedestrian", "other", "bus", "other"]
    with pytest.raises(ValidationError, match=r"expected one of pedestrian, .* found 'lorry'"):
        ClassField.model_validate({"path": "c", "map": {1: "lorry"}})


def test_class_probabilities() -> None:
    keys = {"class": {"path": "k[].name", "probability": "k[].p"}}
    said = [
        [{"name": "car", "p": 0.6}, {"name": "truck", "p": 0.2}],
        [{"name": "car", "p": 0.1}, {"name": "bus", "p": 0.3}, {"name": "car", "p": 0.4}],
        [],
        [{"name": "bus", "p": 0}],
        [{"name": "bus", "p": None}],
        [{"name": "car", "p": -5}, {"name": "bus", "p": 1e300}, {"name": "van", "p": math.nan}],
    ]
    found = one(keys, *({"k": k} for k in said))
    share = found.probability
    assert share.sum(axis=1) == pytest.approx(1)
    assert share[0, CLASSES.index("car")] == pytest.approx(0.75)
    assert share[1, CLASSES.index("car")] == pytest.approx(5 / 8)
    assert classes(found) == ["car", "car", "other", "bus", "bus", "car"]
    beside = one({"class": {"path": "c", "probability": "p"}}, {"c": "car", "p": 0.2})
    assert classes(beside) == ["car"]
    one_for_all = one({"class": {"path": "k[].name", "probability": "p"}}, {"k": said[0], "p": 0.5})
    assert one_for_all.probability[0, CLASSES.index("car")] == pytest.approx(0.5)


def test_enumerations_by_number_and_by_name() -> None:
    definition, payload = in_protobuf(OBJECTS, "List")
    content = {"objects": [{"kind": k, "place": {"x": 1, "y": 2}} for k in ("CAR", "PERSON", "UNKNOWN", 5)]}
    said = {"path": "kind", "map": {1: "truck", "PERSON": "animal", 7: "bus", 5: "trailer", "0": "van"}}
    fields = {"objects": "objects[]", "x_m": "place.x", "y_m": "place.y", "length_m": 4, "width_m": 2, "class": said}
    description = Description(Fields.model_validate(fields))
    found = decode_lists(definition, description, [payload(content)], np.array([1]))
    assert classes(found) == ["truck", "animal", "van", "trailer"]  # a name goes before a number


def test_class_among_keys_and_values() -> None:
    keys = {"class": {"path": "m[].v", "key": "m[].k", "keys": ["class", "label"]}}
    said = [
        [{"k": "speed", "v": "car"}, {"k": "Class", "v": "bus"}],
        [{"k": "label", "v": "pedestrian"}],
        [{"k": "colour", "v": "car"}],
        [{"v": "car"}],
    ]
    assert classes(one(keys, *({"m": m} for m in said))) == ["bus", "pedestrian", "other", "other"]


# ------------------------------------------------------------------------------------ ids, objects that count


def test_ids() -> None:
    found = one({"id": "i"}, {"i": 7}, {"i": "7"}, {"i": "a"}, {"i": 8.0}, {"i": None}, {"i": ""}, {})
    assert ids(found) == ["7", "7", "a", "8"]
    assert noted(found) == ("3 object states without an id: skipped",)
    assert found.columns.rows.tolist() == [4]


def test_ids_that_nobody_has() -> None:
    """vision_msgs has a field for ids, and detectors leave it empty."""
    found = one({"id": "i"}, {"i": ""}, {"i": ""})
    assert len(set(ids(found))) == 2
    assert noted(found) == ()


def test_ids_within() -> None:
    said = [{"n": "a", "i": 1}, {"n": "b", "i": 1}, {"n": "", "i": 1}, {"i": 1}, {"n": "a", "i": 1}, {"n": "a"}]
    found = one({"id": "i"}, *said, within="n")
    assert ids(found) == ["a/1", "b/1", "1", "1", "a/1"]
    assert noted(found) == ("1 object state without an id: skipped",)


def test_only_some_objects() -> None:
    found = one({"id": "i"}, *({"i": k, "t": t} for k, t in enumerate([1, 2, "1", None, 3])), only={"t": ("1", "3")})
    assert ids(found) == ["0", "2", "4"]
    assert noted(found) == ()


def test_what_objects_say_that_they_say() -> None:
    keys = {"vx_mps": "v", "vy_mps": "v", "yaw_rad": "a", "covariance": "c", "velocity": "object"}
    said = {"yaw": "has.y", "velocity": "has.v", "covariance": "has.c"}
    whole = {"v": 2, "a": 0, "c": list(range(36))}
    objects = [{**whole, "has": {"y": k, "v": k, "c": k}} for k in (1, 0)]
    found = one(keys, *objects, said=said)
    assert values(found, "vx_mps") == [2, None]
    assert values(found, "yaw_rad") == [0, 0]
    np.testing.assert_array_equal(found.covariance_m2, [[0, 1, 7], [np.nan] * 3])
    assert noted(found) == ("1 object state that does not say its heading: as written",)


def test_footprints() -> None:
    """A box around the outline where there is no size; turned by 90°, ahead is along +y."""
    outline = [{"x": x, "y": y} for x, y in ((-1, -1), (3, -1), (3, 1), (-1, 1))]
    keys = {"yaw_rad": "a", "length_m": "l", "width_m": "w"}
    turned = {"a": math.pi / 2, "l": 0, "w": 0}
    found = one(
        keys, {**turned, "f": outline}, {**turned, "f": []}, {"a": 0, "l": 5, "w": 2, "f": outline}, footprint="f[]"
    )
    assert values(found, "length_m") == [4, 0, 5]
    assert values(found, "width_m") == [2, 0, 2]
    assert values(found, "x_m") == [1, 1, 1]
    assert values(found, "y_m") == [3, 2, 2]


# ------------------------------------------------------------------------------------ time


def stamps(fields: dict[str, Any], *heads: Any) -> tuple[list[int], list[bool], tuple[str, ...]]:
    found = read(fields, *({"h": h, "o": [OBJECT]} for h in heads), logged=[5] * len(heads))
    return found.columns.stamp_ns.tolist(), found.columns.stamped.tolist(), noted(found)


@pytest.mark.parametrize("pair", [("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"), ("secs", "nsecs")])
def test_stamps_of_seconds_and_nanoseconds(pair: tuple[str, str]) -> None:
    heads = [dict(zip(pair, v, strict=True)) for v in ((1533151603, 547590000), (0, 7), ("2", "5"), (3, None))]
    found = stamps({"stamp": "h"}, *heads)
    assert found == ([1533151603547590000, 7, 2000000005, 5], [True, True, True, False], ())


@pytest.mark.parametrize(
    ("unit", "said", "expected"),
    [
        ("ns", 1533151603547590123, 1533151603547590123),  # beyond 2^53
        ("ns", "1533151603547590123", 1533151603547590123),
        ("us", 1533151603547590, 1533151603547590000),
        ("us", 1533151603547590.5, 1533151603547590500),
        ("ms", 1533151603547, 1533151603547000000),
        ("ms", "1533151603547.590123", 1533151603547590123),
        ("s", 1533151603, 1533151603000000000),
        ("s", 1533151603.547590, 1533151603547590000),  # as it was written, not as doubles have it
        ("s", "1533151603.547590123", 1533151603547590123),
        ("s", -1.5, -1500000000),
        ("s", 1e-9, 1),
        ("s", 0, 0),
    ],
)
def test_stamps_of_one_number(unit: str, said: Any, expected: int) -> None:
    assert stamps({"stamp": {"path": "h", "unit": unit}}, said) == ([expected], [True], ())
    if unit == "s":
        assert stamps({"stamp": "h"}, said) == ([expected], [True], ())


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("1970-01-01T00:00:01Z", 10**9),
        ("2018-08-01T21:20:03.547590123Z", 1533158403547590123),
        ("2018-08-01T21:20:03.547590123", 1533158403547590123),  # without a zone: UTC
        ("2018-08-01 23:20:03,5+02:00", 1533158403500000000),
        ("2018-08-01T16:50:03-0430", 1533158403000000000),
        ("2018-08-01t21:20:03 UTC", 1533158403000000000),
        ("1969-12-31T23:59:59.25Z", -750000000),
        ("2024-02-29T00:00:00.0000000004Z", 1709164800000000000),
    ],
)
def test_stamps_as_iso_8601_has_them(said: str, expected: int) -> None:
    assert stamps({"stamp": "h"}, said) == ([expected], [True], ())
    assert stamps({"stamp": {"path": "h", "unit": "ms"}}, said) == ([expected], [True], ())


def test_dates_that_are_none() -> None:
    said = ["2018-02-30T00:00:00Z", "2018-08-01", "2018-08-01T25:00:00Z", "T", "٢٠١٨-08-01T00:00:00Z"]
    assert stamps({"stamp": "h"}, *said) == ([5] * 5, [False] * 5, ())
    note = "1 message with an impossible time stamp: the time of logging taken"
    assert stamps({"stamp": "h"}, "9999-12-31T23:59:59-23:59") == ([5], [False], (note,))


def test_stamps_that_are_none() -> None:
    note = "message with an impossible time stamp: the time of logging taken"
    assert stamps({"stamp": "h"}, "1e-999999999") == ([0], [True], ())
    assert stamps({"stamp": "h"}, 1, None, "noon", "") == ([10**9, 5, 5, 5], [True, False, False, False], ())
    impossible = [math.nan, math.inf, 1e300, "9e99999999", "-1e18", 5e9]
    found = stamps({"stamp": "h"}, 1, *impossible, *impossible)
    assert found == ([10**9] + [5] * 12, [True] + [False] * 12, (f"12 {note.replace('message', 'messages')}",))


def test_the_stamp_of_the_first_object() -> None:
    objects = [{**OBJECT}, {**OBJECT, "t": 2}, {**OBJECT, "t": 3}]
    found = read({"stamp": "o[].t"}, {"o": objects}, {"o": []})
    assert found.columns.stamp_ns.tolist() == [2 * 10**9, 2 * 10**9 + 1]  # logged 1 ns later
    assert found.columns.stamped.tolist() == [True, False]
    assert read({"stamp": "o[2].t"}, {"o": objects}).columns.stamp_ns.tolist() == [3 * 10**9]


def test_messages_that_cannot_be_decoded() -> None:
    found = read({"stamp": "t"}, {"t": 1, "o": [OBJECT]}, b"{", {"t": 2, "o": 3}, {"t": 3, "o": [OBJECT, OBJECT]})
    assert found.columns.stamp_ns.tolist() == [10**9, 3 * 10**9]
    assert found.columns.rows.tolist() == [1, 2]
    assert found.columns.log_time_ns.tolist() == [1000, 1003]
    assert noted(found) == ("2 messages cannot be decoded: skipped",)


def test_an_object_twice_in_a_list_is_there_twice() -> None:
    """To choose is not the format's business."""
    found = one({"id": "i"}, {"i": 1, "x": 1}, {"i": 1, "x": 2})
    assert values(found, "x_m") == [1, 2]
    assert ids(found) == ["1", "1"]


# ------------------------------------------------------------------------------------ what is not there

DOTTED = {"o": [{**OBJECT, "pose": {"q": quaternion(0)}, "k": [{"n": "car", "p": 1}]}], "h": {"t": 1, "frame": "a"}}


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"objects": "items[]"}, "read.objects: the messages have no list 'items[]'; they have o[], o[].k[]"),
        ({"objects": "o"}, "read.objects: the messages have no list 'o'; they have o[]"),
        ({"objects": "o[0]"}, "read.objects: the messages have no list 'o[0]'; they have o[]"),
        ({"objects": "h"}, "read.objects: the messages have no list 'h'; they have o[]"),
        ({"x_m": "pos.x"}, "read.x_m: the messages have no 'o[].pos.x'; they have .*o[].x"),
        ({"y_m": "x.y"}, "read.y_m: the messages have no 'o[].x.y'"),
        ({"z_m": "/height"}, "read.z_m: the messages have no 'height'; they have "),
        ({"length_m": "q"}, "read.length_m"),
        ({"vx_mps": "v"}, "read.vx_mps"),
        ({"existence": "e"}, "read.existence"),
        ({"id": "track"}, "read.id: the messages have no 'o[].track'"),
        ({"class": "label"}, "read.class: the messages have no 'o[].label'"),
        ({"class": {"path": "k[].n", "probability": "k[].q"}}, "read.class.probability: .*'o[].k[].q'.* o[].k[].p"),
        ({"class": {"path": "k[].n", "key": "k[].q"}}, "read.class.key"),
        ({"yaw_rad": {"quaternion": "pose"}}, "read.yaw_rad.quaternion: .*'o[].pose.x'; they have .*o[].pose.q.x"),
        ({"yaw_rad": {"degrees": "yaw"}}, "read.yaw_rad.degrees"),
        ({"yaw_rad": "heading"}, "read.yaw_rad: "),
        ({"stamp": "h"}, "read.stamp: the messages have no 'h'; they have "),
        ({"stamp": {"path": "h.time"}}, "read.stamp: the messages have no 'h.time'; they have .*h.t"),
        ({"frame": "h.frame_id"}, "read.frame: the messages have no 'h.frame_id'; they have h.frame"),
        ({"covariance": "c"}, "read.covariance: the messages have no 'o[].c[0]'"),
        ({"x_m": "k[].p"}, "read.x_m: 'o[].k[].p' is several values for each of o[]: choose one, 'o[].k[0].p' say"),
        ({"id": "k[].n"}, "read.id: 'o[].k[].n' is several values"),
        ({"class": {"path": "k[].n", "probability": "/o[].x"}}, ""),
        ({"class": {"path": "k[].n", "key": "/other[].x"}}, "read.class.key: the messages have no 'other[].x'"),
        ({"objects": "o[].k[]", "x_m": "/o[].x", "y_m": "p", "id": "/h.t"}, ""),
    ],
)
def test_fields_that_are_not_there(keys: dict[str, Any], told: str) -> None:
    if not told:
        read(keys, DOTTED)
        return
    pattern = ".*".join("".join(c if c.isalnum() else f"\\{c}" for c in part) for part in told.split(".*"))
    with pytest.raises(FieldsError, match=pattern) as raised:
        read(keys, DOTTED)
    assert re.search(r"they have \S|choose one, '\S", str(raised.value))  # it always shows what there is
    assert "\n" not in str(raised.value)


def test_paths_of_another_list() -> None:
    message = {"o": [OBJECT], "other": [{"x": 5}, {"x": 6}]}
    with pytest.raises(FieldsError, match=r"'other\[\].x' is several values for each of o\[\]"):
        read({"x_m": "/other[].x"}, message)
    assert values(read({"x_m": "/other[1].x"}, message), "x_m") == [6]
    with pytest.raises(FieldsError, match=r"read.frame: 'other\[\].x' is several values"):
        read({"frame": "other[].x"}, message)


def test_messages_that_say_nothing() -> None:
    with pytest.raises(FieldsError, match=r"have no list 'o\[\]'; they have nothing"):
        read({}, {})


def test_many_fields_are_not_all_shown() -> None:
    wide = {"o": [{**OBJECT, **{f"field{k}": k for k in range(100)}}]}
    with pytest.raises(FieldsError, match=r"… \(102 in all\)") as raised:
        read({"id": "identity"}, wide)
    assert len(str(raised.value)) < 400


def test_descriptions_that_cannot_be() -> None:
    for yaw in ({}, {"quaternion": "a", "degrees": "b"}, {"quaternion": ""}):
        with pytest.raises(ValidationError):
            Yaw.model_validate(yaw)
    for keys in ({"x_m": 3}, {"objects": ""}, {"velocity": "up"}, {"stamp": {"path": "t", "unit": "h"}}, {"more": 1}):
        with pytest.raises(ValidationError):
            Fields.model_validate({**LEAST, **keys})
    assert Stamp(path="t").unit == "s"


def test_ros_2_in_the_same_words() -> None:
    text = (
        f"builtin_interfaces/Time t\nstring f\nT[] o\n{SEPARATOR}MSG: p/T\nuint8[2] id\nfloat64 x\nfloat64 y\nuint8 c"
    )
    message = {"t": {"sec": 3, "nanosec": 4}, "f": "map", "o": [{"id": [1, 255], "x": 5, "y": 6, "c": 7}]}
    fields = {**LEAST, "id": "id", "stamp": "t", "frame": "f", "class": {"path": "c", "map": {7: "pedestrian"}}}
    found = decode_lists(
        defined(text), Description(Fields.model_validate(fields)), [serialised(text, message)], np.array([9])
    )
    assert found.columns.stamp_ns.tolist() == [3 * 10**9 + 4]
    assert ids(found) == ["01ff"]
    assert classes(found) == ["pedestrian"]
    assert found.frames == ("map",)
    assert values(found, "x_m") == [5]
