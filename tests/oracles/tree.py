"""Messages of JSON and protobuf taken apart value by value, plainly: what the fast ways are held against."""

import json
from typing import Any

import numpy as np

from copem_replay.io.encodings.columns import format_number, list_level, list_levels

UNLIKE = (TypeError, ValueError, AttributeError, RecursionError, OverflowError)


class Enum(int):
    name: str


def json_message(payload: bytes) -> Any:
    message = json.loads(payload)
    if not isinstance(message, dict | list):
        raise TypeError
    return message


def json_child(node: Any, name: str) -> Any:
    return node.get(name)


def protobuf_child(node: Any, name: str) -> Any:
    field = node.DESCRIPTOR.fields_by_name[name]
    if field.has_presence and not node.HasField(name):
        return None
    value = getattr(node, name)
    return value if field.enum_type is None else _named(value, field.enum_type)


def _named(value: Any, enum: Any) -> Any:
    if not isinstance(value, int):
        return [_named(v, enum) for v in value]
    made = Enum(value)
    made.name = {v.number: v.name for v in enum.values}.get(value, str(value))
    return made


def number(value: Any) -> float:
    if isinstance(value, str | bytes):
        try:
            return float(value)
        except ValueError:
            return float("nan")
    if isinstance(value, dict | list):
        raise TypeError
    return float(value)


def text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float | int):
        return format_number(value)
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    raise TypeError


def walk(node: Any, steps: list[str], child: Any) -> list[tuple[tuple[int, ...], Any]]:
    """All values at a path, with the numbers of the items they are of."""
    if not steps or (node is None and "[]" not in steps):
        return [((), node)]
    if node is None:
        return []
    if steps[0] == "[]":
        if isinstance(node, str | dict):
            raise TypeError
        return [((k, *at), v) for k, item in enumerate(node) for at, v in walk(item, steps[1:], child)]
    return walk(child(node, steps[0]), steps[1:], child)


def steps(path: str) -> list[str]:
    return [s for part in path.split(".") for s in (part.rstrip("[]"), *["[]"] * part.count("[]")) if s]


def holds(definition: Any, payloads: list[bytes], decode: Any, child: Any, paths: list[str]) -> None:
    """Assert that messages taken apart are what the plain walk finds: numbers, texts, rows and their parents."""
    found: dict[str, list[Any]] = {path: [] for path in paths}
    rows: dict[str, list[tuple[int, ...]]] = {level: [] for level in list_levels(paths)}
    good = []
    for m, payload in enumerate(payloads):
        try:
            message = decode(payload)
            said = {p: [v for _, v in walk(message, steps(p), child)] for p in paths}
            values = {p: [(None, None) if v is None else (number(v), text(v)) for v in said[p]] for p in paths}
            here = {level: [(m, *at) for at, _ in walk(message, steps(level), child)] for level in rows}
        except UNLIKE:
            good.append(False)
            continue
        good.append(True)
        for path in paths:
            found[path] += values[path]
        for level in rows:
            rows[level] += here[level]
    shredded = definition.shred(payloads, paths, paths)
    assert shredded.decoded.tolist() == good
    for level, expected in rows.items():
        parent = shredded.levels[level].parent.tolist()
        if level:
            assert [rows[list_level(level.removesuffix("[]"))][k] for k in parent] == [at[:-1] for at in expected]
        else:
            assert [(k,) for k in parent] == expected
    for path in paths:
        level = shredded.levels[list_level(path)]
        plain = np.array([np.nan if v is None else v for v, _ in found[path]], dtype=float)
        np.testing.assert_array_equal(level.numbers[path], plain)
        sure = ~np.isnan(plain)
        np.testing.assert_array_equal(np.signbit(level.numbers[path][sure]), np.signbit(plain[sure]))
        words = level.texts[path].words
        assert [words[k] if k >= 0 else None for k in level.texts[path].code] == [w for _, w in found[path]]
