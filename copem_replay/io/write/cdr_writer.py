"""The parts that ROS 2 messages are written of: CDR, little-endian, everything aligned to its own size."""

from __future__ import annotations

import struct

HEAD = b"\0\1\0\0"
"""What every message begins with; alignment is counted from behind it."""
_FIRST_S, _LAST_S = -(2**31), 2**31 - 1


def stamp(time_ns: int) -> bytes:
    """builtin_interfaces/Time. Beyond what its 32 bits hold: the last second they do."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return struct.pack("<iI", min(max(seconds, _FIRST_S), _LAST_S), nanoseconds)


def text(value: str) -> bytes:
    """A string, to begin where 4 divides."""
    encoded = value.encode()
    return struct.pack("<I", len(encoded) + 1) + encoded + b"\0"


def number(value: int) -> bytes:
    """The number of items of a list."""
    return struct.pack("<I", value)


def filled(data: bytes, size: int = 4) -> bytes:
    """The same, up to where `size` divides."""
    return data + bytes(-len(data) % size)


class Cdr:
    """A message that grows field by field, each aligned to its own size."""

    def __init__(self) -> None:
        self._body = bytearray()

    def add(self, kind: str, *values: float) -> None:
        """Numbers of a kind of `struct`: `B`, `I`, `i` or `d`."""
        size = struct.calcsize(kind)
        self._body += bytes(-len(self._body) % size) + struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, value: str) -> None:
        """A string."""
        self._body += bytes(-len(self._body) % 4) + text(value)

    def stamp(self, time_ns: int) -> None:
        """A time."""
        self._body += bytes(-len(self._body) % 4) + stamp(time_ns)

    def message(self) -> bytes:
        """All of it."""
        return HEAD + bytes(self._body)
