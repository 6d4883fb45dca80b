"""Where two folders differ first: file, then column and row, key, line, message or entity. For `same_bytes.py`.

Files are equal byte by byte, but for what KNOWN lists. Only what differs is read.
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from fnmatch import fnmatch
from itertools import zip_longest
from pathlib import Path
from typing import Any

KNOWN: dict[str, tuple[str, ...]] = {
    "*.pieces/*": ("*",),  # their names and contents say which code made them, and when logs were looked at
    # versions; facts; seals
    "*provenance.json": ("copem_replay", "python", "libraries", "format", "configurations", "sha256"),
    "printed_*.txt": (r"note: (?:accuracy|replaying) took .*\n", r"\w+: \d+ (?:%,|of \d+ ).*\n"),  # where it took long
    "*made.jsonl": ("*",),  # seals of .rrd
    "*.rrd": ("rerun.controls.RowId", "log_time", "copem_replay", "rerun_sdk"),  # when it was written, versions
}
"""By file (as for fnmatch, below the compared folder) what may differ: all ("*"), keys, columns, patterns of text.

Ids of views and containers in an .rrd are new in each writing, too: they are told by what they hold.
"""
Difference = str | None
_ORDER = (".parquet", ".csv", ".json", ".yaml", ".mcap", ".rrd")
_MISSING = object()
_UUID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_UUID_AS_BYTES = re.compile(r"\[(\d+(?:, \d+){15})\]")
_NESTING = 8
"""Rounds in which ids are named by what they hold: more than layouts are deep."""


def may_differ(name: str) -> tuple[str, ...]:
    return tuple(key for pattern, keys in KNOWN.items() if fnmatch(name, pattern) for key in keys)


def difference_of_folders(before: Path, after: Path) -> Difference:
    """The first difference, and how many files more differ; None: there is none."""
    one, other = (
        {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
        for folder in (before, after)
    )
    found: list[str] = []
    for name in sorted(one.keys() | other.keys(), key=_tables_first):
        if "*" in may_differ(name):
            continue
        if name not in one or name not in other:
            found.append(f"{name}: only {'before' if name in one else 'after'}")
        elif (difference := difference_of_files(one[name], other[name], may_differ(name))) is not None:
            found.append(f"{name}: {difference}")
    return found[0] + (f"; and {len(found) - 1} more files" if found[1:] else "") if found else None


def _tables_first(name: str) -> tuple[int, str]:
    """What else is written is made of tables."""
    suffix = Path(name).suffix
    return _ORDER.index(suffix) if suffix in _ORDER else len(_ORDER), name


def difference_of_files(before: Path, after: Path, known: tuple[str, ...] = ()) -> Difference:
    """None: equal byte by byte, or in all but what is known to differ."""
    one, other = before.read_bytes(), after.read_bytes()
    if one == other:
        return None
    if before.suffix == ".rrd":
        return _of_rows(_rrd_rows(before, known), _rrd_rows(after, known))
    if before.suffix == ".json" and known:  # other JSON is compared as it is written
        return _of_json(*({k: v for k, v in json.loads(raw).items() if k not in known} for raw in (one, other)))
    if before.suffix == ".txt" and known:
        return _of_text(*(re.sub("|".join(known), "", raw.decode()) for raw in (one, other)))
    finer: dict[str, Callable[[Path, Path], Difference]] = {
        ".parquet": _of_tables, ".mcap": _of_messages, ".csv": _of_csv, ".png": lambda *_: None,
    }  # fmt: skip
    at = _common(one, other)
    return finer.get(before.suffix, _of_lines)(before, after) or f"byte {at} of {len(one)} and {len(other)}"


def _common(one: Sequence[object], other: Sequence[object]) -> int:
    """How much of their begin is alike."""
    return next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))


def _of_json(before: Any, after: Any, place: str = "") -> Difference:
    if isinstance(before, dict) and isinstance(after, dict):
        keys = [*before, *(key for key in after if key not in before)]
        pairs = ((f"{place}.{key}", before.get(key, _MISSING), after.get(key, _MISSING)) for key in keys)
    elif isinstance(before, list) and isinstance(after, list):
        both = zip_longest(before, after, fillvalue=_MISSING)
        pairs = ((f"{place}[{k}]", one, other) for k, (one, other) in enumerate(both))
    else:
        return None if repr(before) == repr(after) else f"{place.lstrip('.')}: {_change(before, after)}"
    return next((found for at, *two in pairs if (found := _of_json(*two, at)) is not None), None)


def _change(before: object, after: object) -> str:
    """What was and what is, shortened where it is long: from shortly before where it begins to differ."""
    one, other = ("nothing" if value is _MISSING else str(value) for value in (before, after))
    begin = max(0, _common(one, other) - 30)
    one, other = (("… " if begin else "") + text[begin:] for text in (one, other))
    return " -> ".join(text if len(text) <= 100 else f"{text[:100]} …" for text in (one, other))


def _of_lines(before: Path, after: Path) -> Difference:
    return _of_text(*(path.read_text(encoding="utf-8", errors="replace") for path in (before, after)))


def _of_text(before: str, after: str) -> Difference:
    lines = (text.splitlines() for text in (before, after))
    for number, (one, other) in enumerate(zip_longest(*lines, fillvalue=_MISSING), 1):
        if one != other:
            return f"line {number}: {_change(one, other)}"
    return None


def _of_csv(before: Path, after: Path) -> Difference:
    one, other = (list(csv.reader(path.read_text(encoding="utf-8").splitlines())) for path in (before, after))
    if one[:1] != other[:1]:
        return f"columns: {_change(one[:1], other[:1])}"
    columns = [dict(zip(one[0], zip(*table[1:], strict=True), strict=True)) for table in (one, other)]
    return _of_columns(*columns)


def _of_tables(before: Path, after: Path) -> Difference:
    import pyarrow.parquet as pq

    one, other = (pq.ParquetFile(path).read() for path in (before, after))
    if not one.schema.equals(other.schema):
        columns = ([f"{field.name}: {field.type}" for field in table.schema] for table in (one, other))
        return _change(*columns)
    return _of_columns(
        *({name: table.column(name).to_pylist() for name in table.column_names} for table in (one, other))
    )


def _of_columns(before: dict[str, Any], after: dict[str, Any]) -> Difference:
    """The first column that differs, its first row that does, and how many rows and columns do."""
    found, rows, columns = None, 0, 0
    for name, column in before.items():
        pairs = enumerate(zip_longest(column, after[name], fillvalue=_MISSING))
        off = [(row, one, other) for row, (one, other) in pairs if repr(one) != repr(other)]
        columns += bool(off)
        if off and found is None:
            (row, one, other), rows = off[0], len(off)
            found = f"column {name}, row {row}: {_change(one, other)} ({rows} rows of {len(column)} in it"
    return found and f"{found}; {columns} columns of {len(before)})"


def _of_messages(before: Path, after: Path) -> Difference:
    both = zip_longest(_messages(before), _messages(after), fillvalue=_MISSING)
    for number, (one, other) in enumerate(both):
        if one != other:
            return f"message {number}: {_change(one, other)}"
    return None


def _messages(path: Path) -> Iterator[tuple[object, ...]]:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            name = schema.name if schema else None
            yield channel.topic, name, message.log_time, message.publish_time, message.sequence, message.data


# ----------------------------------------------------------------------------------------------- Rerun's recordings


Rows = dict[str, list[str]]
"""By store, entity and columns: what its rows say, in the order in which they were logged."""


def _rrd_rows(path: Path, known: tuple[str, ...]) -> Rows:
    from rerun.chunk import RrdReader

    reader, rows = RrdReader(str(path)), Rows()
    for store in reader.recordings():
        rows["recording"] = [*rows.get("recording", ()), f"{store.application_id} {store.recording_id}"]
        rows |= dict(_entity_rows(reader.stream(store=store), known))
    for store in reader.blueprints():
        rows |= _named_by_content(dict(_entity_rows(reader.stream(store=store), known)))
    return rows


def _entity_rows(chunks: Any, known: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
    """How rows are cut into chunks says nothing; the ids of rows say their order."""
    found: dict[str, list[tuple[bytes, str]]] = defaultdict(list)
    for chunk in chunks:
        table = chunk.to_record_batch()
        names = [name for name in table.schema.names if name not in known]
        columns = zip(*(table.column(name).to_pylist() for name in names), strict=True) if names else ()
        key = f"{chunk.entity_path} {' '.join(names)}{' (static)' if chunk.is_static else ''}"
        ids = table.column("rerun.controls.RowId").to_pylist()
        found[key] += [(row, str(values)) for row, values in zip(ids, columns, strict=False)]
    for key, rows in found.items():
        yield key, [text for _, text in sorted(rows)]


def _named_by_content(rows: Rows) -> Rows:
    """Ids of views and containers in the place of what they hold, however deep."""
    lines = [f"{key}\n{_UUID_AS_BYTES.sub(_uuid_text, text)}" for key, texts in rows.items() for text in texts]
    of: dict[str, list[str]] = defaultdict(list)
    for line in lines:
        for name in set(_UUID.findall(line.partition("\n")[0])):
            of[name].append(line)
    names: dict[str, str] = {}

    def named(line: str, own: str = "") -> str:
        return _UUID.sub(lambda found: "*" if found[0] == own else names.get(found[0], "?"), line)

    for _ in range(_NESTING):
        told = {name: sorted(named(line, name) for line in mine) for name, mine in of.items()}
        names = {name: hashlib.sha256("\n".join(mine).encode()).hexdigest()[:8] for name, mine in told.items()}
    found: Rows = defaultdict(list)
    for line in sorted(map(named, lines)):
        key, _, text = line.partition("\n")
        found[f"layout {key}"].append(text)
    return dict(found)


def _uuid_text(numbers: re.Match[str]) -> str:
    values = [int(value) for value in numbers[1].split(", ")]
    return str(uuid.UUID(bytes=bytes(values))) if max(values) < 256 else numbers[0]


def _of_rows(before: Rows, after: Rows) -> Difference:
    """Entities that differ in what they hold come before those that only one side has: layouts name by content."""
    keys = sorted(before.keys() | after.keys(), key=lambda key: (key.startswith("layout"), key))
    for key in keys:
        if key not in before or key not in after:
            rows = before.get(key, after.get(key, []))
            return f"only {'before' if key in before else 'after'}: {key}: {' '.join(rows)[:100]}"
        for number, (one, other) in enumerate(zip_longest(before[key], after[key], fillvalue=_MISSING)):
            if one != other:
                return f"{key}, row {number}: {_change(one, other)}"
    return None
