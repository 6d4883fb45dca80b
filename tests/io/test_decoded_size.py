"""What messages may take once decoded: estimates from above, by hand, and the limits themselves."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from copem_replay.io.decoded_size import (
    MESSAGE_LIMIT_BYTES,
    DecodeAllowance,
    OversizeError,
    check_decoded_bytes,
    check_json,
    check_objects,
)
from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.encodings.protobuf import ProtobufSize, estimate_decoded_bytes
from tests.helpers.recordings import Obj, ground_truth

# Type 0 has a message of type 1 as field 1, a text as field 2 and numbers as field 5; type 1 has itself as field 1.
FIELDS = np.array([[1, 0, 1], [2, 1, -1], [5, 2, -1], [1, 0, 1]])
FIRST, SIZES = np.array([0, 3, 4]), np.array([100, 50])


@pytest.mark.parametrize(
    ("message", "beside"),
    [
        (b"", 0),
        (b"\x0a\x00\x0a\x00", 50 + 50),
        (b"\x0a\x04\x0a\x02\x0a\x00", 50 + 50 + 50),
        (b"\x12\x03abc", 24),
        (b"\x28\x07\x28\x07", 8 + 8),
        (b"\x2a\x03\x01\x02\x03", 3 * 8),  # three numbers in one field
        (b"\x0b\x0b\x0c\x0c", 50 + 50),  # groups
        (b"\x18\x01\x0a\x00", 32 + 50),  # field 3 is of no type
        (b"\x0a\x00\x0a\x7f", 50),  # the second has no end: the parser refuses it
        (b"\xff", 0),
    ],
)
def test_memory_of_a_message(message: bytes, beside: int) -> None:
    """Its bytes, 100 for itself, and what is inside."""
    data = np.frombuffer(message, dtype=np.uint8)
    assert estimate_decoded_bytes(data, FIELDS, FIRST, SIZES, 10**9) == len(message) + 100 + beside


def test_what_is_beyond_the_limit_is_not_counted_on() -> None:
    data = np.frombuffer(b"\x0a\x00" * 1000, dtype=np.uint8)
    assert estimate_decoded_bytes(data, FIELDS, FIRST, SIZES, 2400) == 2000 + 100 + 7 * 50


def test_types_that_hold_themselves_and_types_with_many_fields() -> None:
    """An empty message of a type with 5,000 fields takes 40 kB: 20 kB of them are too much already."""
    from google.protobuf import descriptor_pool

    file = FileDescriptorProto(name="wide.proto", syntax="proto3")
    list_, wide = file.message_type.add(name="List"), file.message_type.add(name="Wide")
    list_.field.add(name="wide", number=1, type=11, label=3, type_name=".Wide")
    list_.field.add(name="list", number=2, type=11, label=3, type_name=".List")
    for k in range(5000):
        wide.field.add(name=f"f{k}", number=k + 1, type=1, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    size = ProtobufSize(pool.FindMessageTypeByName("List"))
    size.check(b"\x0a\x00" * 9_000)
    with pytest.raises(OversizeError, match="a message would take more than 384 MiB of memory"):
        size.check(b"\x0a\x00" * 11_000)
    size.check(b"\x12\x00" * 11_000)


def test_a_full_list_of_objects_is_far_from_the_limit() -> None:
    """100,000 objects as a simulator writes them."""
    one = ground_truth(None, [Obj(id=1 << 40, x=1.5, y=2.5, yaw=0.5, vx=3.5, vy=0.5)])
    ProtobufSize(one.DESCRIPTOR).check(one.SerializeToString() * 100_000)


def test_limits_are_what_may_still_be() -> None:
    check_decoded_bytes(MESSAGE_LIMIT_BYTES)
    check_objects(100_000)
    check_json(b'{"a": 1.5, "b": [1, 2]}' * 10)
    allowance = DecodeAllowance(1000)  # 256 MiB + 400 kB
    allowance.spend(256 << 20)
    for _ in range(100):
        allowance.spend(0, 39)  # 40 × 100 bytes
    with pytest.raises(OversizeError, match=r"^its messages would take more than 256 MiB and 400 times the size of"):
        allowance.spend(1)
    with pytest.raises(OversizeError, match="a message lists 100001 objects"):
        check_objects(100_001)
    with pytest.raises(OversizeError, match="more than 384 MiB"):
        check_decoded_bytes(MESSAGE_LIMIT_BYTES + 1)


@pytest.mark.parametrize("value", [b"{}", b"[]", b"[{},[]]"])
def test_json_of_empty_values(value: bytes) -> None:
    """Without making the message: bytes tell what they would become. Of texts alone as many bytes may be."""
    check_json(b"[" + b",".join([value] * 100_000) + b"]")
    check_json(b'"' + b"a" * 50_000_000 + b'"')
    with pytest.raises(OversizeError, match="more than 384 MiB"):
        check_json(b"[" + b",".join([value] * 6_000_000) + b"]")


def test_cdr_that_becomes_more_rows_than_it_has_bytes() -> None:
    """A truth value in a list is one byte, and takes 25 in columns: 20 million of them are too many."""
    definition = CdrDefinition("x/msg/Bits", "ros2msg", b"bool[] bits\n")

    def message(number: int) -> bytes:
        return b"\0\1\0\0" + number.to_bytes(4, "little") + b"\1" * number

    assert definition.shred([message(1000)], ["bits[]"], []).levels["bits[]"].numbers["bits[]"].sum() == 1000
    with pytest.raises(OversizeError, match="more than 384 MiB"):
        definition.shred([message(20_000_000)], ["bits[]"], [])
