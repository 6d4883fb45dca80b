"""How much memory messages take once they are decoded, estimated from their bytes before anything parses them.

A parser makes up to hundreds of bytes of two: an empty object is two bytes in protobuf and three in JSON, and sixty
million of them compress to less than a megabyte. So what a message takes is estimated first, from above, with one pass
over its bytes. Messages that cannot exceed the limit by their length alone, nearly all there are, cost a comparison.
"""

from __future__ import annotations

from typing import Final

from copem_replay.io.channel import DefinitionError

MOST_OBJECTS: Final = 100_000
"""Objects of one message: a city has fewer at a time. Points of lane boundaries and of outlines are none."""
MESSAGE_LIMIT_BYTES: Final = 384 << 20
"""Memory of one decoded message: that of a map with two million boundary points."""
MOST_GROWTH: Final = 400
"""Memory of all messages that are decoded at once, in sizes of the file, beyond `SMALL_BYTES`: recordings of traffic
need 2 to 40."""
SMALL_BYTES: Final = 256 << 20
STATE_BYTES: Final = 100
"""Memory of an object state in columns."""


class OversizeError(DefinitionError):
    """Messages that would take more memory than any recording of traffic does."""


def check_decoded_bytes(estimate: int) -> None:
    """Raises OversizeError where a message would take more than `MESSAGE_LIMIT_BYTES`."""
    if estimate > MESSAGE_LIMIT_BYTES:
        raise OversizeError(
            f"a message would take more than {MESSAGE_LIMIT_BYTES >> 20} MiB of memory: no list of objects does"
        )


def check_objects(most: int) -> None:
    """Raises OversizeError where the message with the most objects has more than `MOST_OBJECTS`."""
    if most > MOST_OBJECTS:
        raise OversizeError(f"a message lists {most} objects: expected at most {MOST_OBJECTS}")


class DecodeAllowance:
    """The memory that the messages of a recording of `file_bytes` may take that are decoded together."""

    def __init__(self, file_bytes: int) -> None:
        self._left = SMALL_BYTES + MOST_GROWTH * file_bytes

    def spend(self, message_bytes: int, states: int = 0) -> None:
        """Count a message and its object states. Raises OversizeError: more than the allowance."""
        self._left -= max(message_bytes, STATE_BYTES * (1 + states))
        if self._left < 0:
            raise OversizeError(
                f"its messages would take more than {SMALL_BYTES >> 20} MiB and {MOST_GROWTH} times the size of the "
                "file in memory: no recording of traffic does"
            )


# JSON.

_OBJECT_BYTES, _VALUE_BYTES, _TEXT_BYTES = 200, 64, 4
"""Memory of a dictionary, of a list or any other value, and of a byte of text (four where one character is wide)."""
_JSON_GROWTH = _OBJECT_BYTES  # of `{},` it is 92


def check_json(payload: bytes) -> None:
    """Raises OversizeError where a message of JSON would take too much memory."""
    if len(payload) * _JSON_GROWTH > MESSAGE_LIMIT_BYTES:
        values = payload.count(b"[") + payload.count(b",")
        check_decoded_bytes(_TEXT_BYTES * len(payload) + _OBJECT_BYTES * payload.count(b"{") + _VALUE_BYTES * values)
