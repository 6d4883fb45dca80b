"""A table with one row per object and instant, the units in the names of its columns (docs/guide/data-sets.md)."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError, quote_value
from copem_replay.extras.convert.conversion import (
    KINDS,
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    number_names,
    parse_number_or_none,
    parse_seconds_as_ns,
    wrap_yaw,
)
from copem_replay.io.findings import LONGEST_M

REQUIRED: Final = ("time_s", "id", "class", "x_m", "y_m", "length_m", "width_m")
_NUMBERS: Final = ("x_m", "y_m", "length_m", "width_m")
YAW: Final = ("yaw_deg", "yaw_rad")  # one of them
OPTIONAL: Final = ("z_m", "height_m", "vx_mps", "vy_mps", "moving", "host")
_YES_NO: Final = {"1": True, "true": True, "0": False, "false": False}


@dataclass(frozen=True)
class _BoxRow:
    """A row; None: the cell is empty, or there is no such column."""

    line: int
    stamp_ns: int
    name: str
    kind: OsiKind
    at_m: tuple[float, float]
    z_m: float | None
    yaw_rad: float
    size_m: tuple[float, float]
    height_m: float | None
    velocity_mps: tuple[float, float] | None
    moving: bool
    host: bool


def frames(path: Path, report: ConversionReport) -> Iterator[ConvertedFrame]:
    """All instants in order of time. Raises InputError."""
    rows = list(_read_rows(path, report))
    ids = number_names(row.name for row in rows)
    report.names |= {ident: name for name, ident in ids.items()}
    hosts = {row.name: row.line for row in rows if row.host}
    if len(hosts) > 1:
        (first, _), (second, line) = list(hosts.items())[:2]
        raise InputError(
            f"{path}:{line}: host: expected one object, found {quote_value(second)} besides {quote_value(first)}"
        )
    moves = {row.name for row in rows if row.moving}
    for name in hosts:
        if name not in moves:
            raise InputError(f"{path}:{hosts[name]}: host: expected an object that moves, found {quote_value(name)}")
    report.count("object", "that do not move at all: stationary", len(ids.keys() - moves))
    instants: dict[int, dict[str, _BoxRow]] = {}
    for row in rows:
        at_once = instants.setdefault(row.stamp_ns, {})
        if row.name in at_once:
            line = at_once[row.name].line
            raise InputError(
                f"{path}:{row.line}: id: expected each object once at a time, found {row.name} in line {line}"
            )
        at_once[row.name] = row
    host = next((ids[name] for name in hosts), None)
    for stamp_ns in sorted(instants):
        boxes = [_make_box(row, ids[row.name], report, moves=row.name in moves) for row in instants[stamp_ns].values()]
        yield ConvertedFrame(stamp_ns, boxes, host)


def _make_box(row: _BoxRow, ident: int, report: ConversionReport, *, moves: bool) -> Box:
    """The box of a row; a missing height or z is that of its class; `moves`: the object does in some row."""
    kind = row.kind
    if moves != kind.moving:
        kind = KINDS["other"] if moves else OsiKind("static", False, KINDS["static"].type, like=kind.like)
    height_m = kind.height_m if row.height_m is None else row.height_m
    if row.height_m is None:
        report.count("row", "without height_m: the typical height of the class taken")
    if row.z_m is None:
        report.count("row", "without z_m: stood on z = 0")
    stated_height_m = abs(height_m) if 0.0 < abs(height_m) <= LONGEST_M else kind.height_m
    z_m = stated_height_m / 2 if row.z_m is None else row.z_m
    return Box(ident, kind, (*row.at_m, z_m), row.yaw_rad, (*row.size_m, height_m), row.velocity_mps)


def _read_rows(path: Path, report: ConversionReport) -> Iterator[_BoxRow]:
    """The rows of a table. Raises InputError."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            lines = csv.reader(stream, strict=True)
            header = [name.strip() for name in next(lines, [])]
            _check_header(header, path)
            for cells in lines:
                if not any(cell.strip() for cell in cells):
                    continue
                if len(cells) != len(header):
                    raise InputError(
                        f"{path}:{lines.line_num}: expected {len(header)} cells, as in the header, found {len(cells)}"
                    )
                named = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
                yield _parse_row(named, f"{path}:{lines.line_num}", lines.line_num, report)
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected comma-separated UTF-8 text, found something else: {error}") from None


def _check_header(header: list[str], path: Path) -> None:
    """Raise InputError where the header lacks columns, has unknown ones, or one twice."""
    where = f"{path}:1"
    if missing := [name for name in REQUIRED if name not in header]:
        found = ", ".join(header[:20]) or "nothing"
        raise InputError(f"{where}: expected the columns {', '.join(missing)}, too, found {quote_value(found)}")
    if len([name for name in YAW if name in header]) != 1:
        raise InputError(
            f"{where}: expected either {YAW[0]} or {YAW[1]}, found {'both' if YAW[0] in header else 'none'}"
        )
    columns = (*REQUIRED, *YAW, *OPTIONAL)
    for name in header:
        if name not in columns:
            raise InputError(f"{where}: expected columns of {', '.join(columns)}, found {quote_value(name)}")
        if header.count(name) > 1:
            raise InputError(f"{where}: expected each column once, found {name} {header.count(name)} times")
    if ("vx_mps" in header) != ("vy_mps" in header):
        raise InputError(f"{where}: expected both vx_mps and vy_mps or none, found one")


def _parse_row(cells: dict[str, str], where: str, line: int, report: ConversionReport) -> _BoxRow:
    """The values of a row. An empty cell of an optional column counts as no such column. Raises InputError."""

    def given(name: str) -> float | None:
        return parse_number_or_none(cells[name], f"{where}: {name}") if cells.get(name) else None

    def flag(name: str, otherwise: bool) -> bool:
        if not cells.get(name):
            return otherwise
        if (value := _YES_NO.get(cells[name].lower())) is None:
            raise InputError(f"{where}: {name}: expected 0, 1, false or true, found {quote_value(cells[name])}")
        return value

    if not cells["class"]:
        raise InputError(f"{where}: class: expected one of {', '.join(KINDS)}, found nothing")
    kind = report.find_kind(cells["class"], "row")
    if not cells["id"]:
        raise InputError(f"{where}: id: expected a name or number, found nothing")
    yaw = next(name for name in YAW if name in cells)
    numbers = (parse_number_or_none(cells[name], f"{where}: {name}") for name in (yaw, *_NUMBERS))
    yaw_value, x_m, y_m, length_m, width_m = numbers
    vx, vy = given("vx_mps"), given("vy_mps")
    if (vx is None) != (vy is None):
        raise InputError(
            f"{where}: {'vx_mps' if vx is None else 'vy_mps'}: expected a number beside the other, found nothing"
        )
    return _BoxRow(
        line=line,
        stamp_ns=parse_seconds_as_ns(cells["time_s"], f"{where}: time_s"),
        name=cells["id"],
        kind=kind,
        at_m=(x_m, y_m),
        z_m=given("z_m"),
        yaw_rad=wrap_yaw(math.radians(yaw_value) if yaw == "yaw_deg" else yaw_value),
        size_m=(length_m, width_m),
        height_m=given("height_m"),
        velocity_mps=None if vx is None or vy is None else (vx, vy),
        moving=flag("moving", kind.moving),
        host=flag("host", False),
    )
