"""Pieces that are kept: in a folder or under a URL, what was computed once is found again by the key of its recipe.

    pieces/ab/<key>.parquet        rows of `detections.parquet`, and what stands beside them; the recipe in the metadata
    pieces/ab/<key>.sums.parquet   a row per run, sums of accuracy in the metadata; written first
    logs/<key>.json                what is known of a log, so that it need not be read again

A piece is done when its `.parquet` is there. Two that write the same piece write the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from copem_replay.metrics.accuracy.statistics import BAND, EXISTENCE, OBJECT, RUN, Settings, Total
from copem_replay.pipeline.log_tables import BESIDE, RUNS, LogTables
from copem_replay.pipeline.recipe import canonical, key_of
from copem_replay.pipeline.store import Store, store_at

ROWS_A_PIECE = 250_000
"""Rows of a range of runs at most (chosen: some MB)."""
FIRST_RUNS = 64
"""Runs of the first range (chosen)."""
_BESIDE = "beside:"
"""Before names of columns that stand beside rows."""
_SEAL, _ZEROS = b"seal:", b"0" * 40
_WHOSE = ("log", "configuration")
_RECORDS = {"episodes": OBJECT, "runs": RUN, "ghosts_at": np.dtype("i8"), "by_distance": BAND, "by_time": BAND,
            "by_existence": EXISTENCE}  # fmt: skip


def ranges(runs: int, episodes: int) -> Iterator[tuple[int, int]]:
    """The ranges of runs that are pieces: of 64, 64, 128, … up to a power of two, then of as many, the last cut.

    They depend on nothing but the log and what is measured in it, so that more runs find what is there.
    """
    most = max(1, ROWS_A_PIECE // max(episodes, 1))
    most = 1 << most.bit_length() - 1
    begin, size = 0, min(FIRST_RUNS, most)
    while begin < runs:
        yield begin, min(begin + size, runs)
        begin += size
        size = min(begin, most)


class Pieces:
    """What is kept at an address: a folder or a URL. `found`, `computed`: how many of a study; `damaged`: those that
    had to be computed again. Raises InputError, OutputError where nothing can be kept.
    """

    def __init__(self, address: str | Path) -> None:
        self.address = str(address)
        self.store: Store = store_at(address)
        self.found = self.computed = 0
        self.damaged: list[str] = []

    def read(self, recipe: str, log: str, configuration: str) -> LogTables | None:
        """A piece of a log and configuration; None: it is not there, or damaged. Raises InputError."""
        name = name_of(recipe)
        try:
            content = self.store.read(name)
            return None if content is None else _read(content, self.store, recipe, log, configuration)
        except (OSError, ValueError, KeyError, TypeError) as error:  # what Arrow raises derives from these
            said = " ".join(str(error).split())[:120]
            self.damaged.append(f"{self.store.where}/{name}: damaged, computed again ({said})")
            return None

    def write(self, recipe: str, piece: LogTables) -> LogTables:
        """Keep a piece. Returns it as it will be read. Raises OutputError."""
        assert isinstance(piece.rows, pd.DataFrame)
        name, rows = name_of(recipe), pa.Table.from_pandas(piece.rows, preserve_index=False)
        said = {b"recipe": recipe.encode()}
        table = rows.drop_columns(list(_WHOSE))
        if piece.beside is not None and piece.runs is not None:
            totals = canonical([[count, _as_json(of)] for nodes in piece.totals.values() for count, of in nodes])
            sums = _sealed(piece.runs.drop_columns(list(_WHOSE)), {b"sums": totals.encode()})
            self.store.write(_sums_of(name), sums)
            said[b"sums"] = _digest(sums)
            for column in piece.beside.column_names:
                table = table.append_column(_BESIDE + column, piece.beside[column])
        self.store.write(name, _sealed(table, said))
        self.computed += 1
        return LogTables(piece.log, rows, piece.beside, piece.runs, piece.totals)

    def keys(self) -> Callable[[str], bool]:
        """Whether there is a piece, by its key. Under a URL all is listed anew, what other processes wrote, too."""
        self.store.refresh()
        return lambda key: self.store.exists(_name(key))

    def known(self, about: str) -> dict[str, Any] | None:
        """What is known of a log, by all that it was made of; None: nothing."""
        try:
            said: Any = json.loads(self.store.read(f"logs/{key_of(about)}.json") or b"")
            digest = said.pop("digest")
        except (OSError, ValueError, KeyError, AttributeError):
            return None
        return said if digest == key_of(canonical(said)) else None

    def keep(self, about: str, said: Mapping[str, Any]) -> None:
        """And for the next time. Raises OutputError."""
        text = canonical(dict(said) | {"digest": key_of(canonical(said))})
        self.store.write(f"logs/{key_of(about)}.json", text.encode())

    def forget(self, about: str) -> None:
        """Know nothing of a log by this any more. Raises OutputError."""
        self.store.write(f"logs/{key_of(about)}.json", b"")


def name_of(recipe: str) -> str:
    """What the piece that is made by a recipe is called in a store."""
    return _name(key_of(recipe))


def _name(key: str) -> str:
    return f"pieces/{key[:2]}/{key}.parquet"


def _sums_of(name: str) -> str:
    return name.removesuffix(".parquet") + ".sums.parquet"


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=20).hexdigest().encode()


def _sealed(table: pa.Table, said: Mapping[bytes, bytes]) -> bytes:
    """A table as Parquet with its own digest in the metadata: that of the file with zeros in the digest's place."""
    stream = pa.BufferOutputStream()
    table = table.replace_schema_metadata({**said, _SEAL[:-1]: _SEAL + _ZEROS}).combine_chunks()
    parquet.write_table(table, stream, compression="zstd")
    content: bytes = stream.getvalue().to_pybytes()
    return content.replace(_SEAL + _ZEROS, _SEAL + _digest(content))


def _opened(content: bytes) -> pa.Table:
    """And back. Raises ValueError where a bit of it is another."""
    begin, _, end = content.partition(_SEAL)
    if _digest(begin + _SEAL + _ZEROS + end[len(_ZEROS) :]) != end[: len(_ZEROS)]:
        raise ValueError("another content")
    return parquet.ParquetFile(pa.BufferReader(content)).read(use_threads=False)  # for so little they only cost time


def _read(content: bytes, store: Store, recipe: str, log: str, configuration: str) -> LogTables:
    """Raises ValueError, KeyError, TypeError or OSError where anything is not as it was written."""
    table = _opened(content)
    said = table.schema.metadata
    if said[b"recipe"] != recipe.encode():
        raise ValueError("another recipe")
    names = [name for name in table.column_names if not name.startswith(_BESIDE)]
    rows = _whose(table.select(names), log, configuration)
    if b"sums" not in said:
        return LogTables(log, rows)
    beside_it = store.read(_sums_of(name_of(recipe)))
    if beside_it is None or _digest(beside_it) != said[b"sums"]:
        raise ValueError("other sums")
    sums = _opened(beside_it)
    nodes = [(count, _total(of)) for count, of in json.loads(sums.schema.metadata[b"sums"])]
    beside = table.select([name for name in table.column_names if name.startswith(_BESIDE)])
    beside = beside.rename_columns([name.removeprefix(_BESIDE) for name in beside.column_names])
    runs = _whose(sums.replace_schema_metadata(None), log, configuration).cast(RUNS)
    beside = beside.replace_schema_metadata(None).cast(BESIDE)  # which calls what is in lists as it was called
    return LogTables(log, rows, beside, runs, {configuration: nodes} if nodes else {})


def _whose(table: pa.Table, *whose: str) -> pa.Table:
    for k, (name, value) in enumerate(zip(_WHOSE, whose, strict=True)):
        table = table.add_column(k, name, pa.repeat(pa.scalar(value, pa.string()), len(table)))
    return table


def _as_json(of: Total) -> dict[str, Any]:
    arrays = {name: np.ascontiguousarray(getattr(of, name)).tobytes().hex() for name in _RECORDS}
    return {f.name: getattr(of, f.name) for f in fields(Total)} | {"settings": asdict(of.settings)} | arrays


def _total(said: dict[str, Any]) -> Total:
    settings: dict[str, Any] = {n: _tuples(v) for n, v in said["settings"].items()}
    arrays = {name: np.frombuffer(bytes.fromhex(said[name]), dtype=kind) for name, kind in _RECORDS.items()}
    one = {name: arrays[name].reshape(()) for name in ("episodes", "runs")}
    return Total(**said | {"settings": Settings(**settings)} | arrays | one)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
