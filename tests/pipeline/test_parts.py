"""Parts: what was computed once is found again, and results with and without them are the same bytes."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import ipc

from copem_replay.core.errors import InputError, OutputError
from copem_replay.experiment import validate
from copem_replay.pipeline import parts as parts_module
from copem_replay.pipeline import run as study_tables
from copem_replay.pipeline.parts import cut_parts
from copem_replay.results import table_files
from copem_replay.results import write as results_write
from tests.cli.test_api import cr
from tests.helpers.experiments import changed, drive

FLEET = "  mast: {on: {classes: [car], penetration_rate: 0.5}, pem: onboard}"
EXACT = "measure: {onset: {kind: in_range, range_m: 60}, exact: true}"

LINKS = "links: {v2x: {latency: 0.1, reception: {kind: constant, probability: 0.6}}}"
RADIO = "  radio: {units: all, link: v2x}\n  last: {units: [mast]}\nmeasure:"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        drive(tmp_path / f"{name}.mcap")
    return tmp_path


def study(*changes: str, runs: int = 130, gnn: bool = False) -> str:
    text = changed(f"runs: {runs}", "logs: [a.mcap, b.mcap]", *changes)
    return text.replace("measure:", "  gnn: {units: all, fusion: {kind: gnn}}\nmeasure:") if gnn else text


def replayed(text: str, out: str, kept: str | None = "kept") -> tuple[dict[str, bytes], int, int]:
    """Files of the results, and how many parts were computed and found."""
    Path("e.yaml").write_text(text)
    result = cr.run("e.yaml", jobs=2, pieces=kept)
    result.save(out, overwrite=True)
    store = result.study.logs[0].parts
    counts = (0, 0) if store is None else (store.computed, store.found)
    files = {str(path.relative_to(out)): path.read_bytes() for path in Path(out).rglob("*") if path.is_file()}
    return {name: content for name, content in files.items() if not name.endswith((".rrd", "made.jsonl"))}, *counts


@pytest.mark.parametrize(
    "text",
    [
        study(gnn=True),
        study(EXACT, "sweep: {latency_s: [0, 0.3]}"),
        study(FLEET, runs=70),
        study("measure: {onset: {kind: in_range, range_m: 60}, accuracy: false}"),
        study(LINKS, runs=70, gnn=True).replace("measure:", RADIO),
    ],
    ids=["fusions", "exact and swept", "fleet", "without accuracy", "links"],
)
def test_the_same_bytes_computed_found_and_half_found(text: str, here: Path) -> None:
    plain, _, _ = replayed(text, "plain", None)
    first, computed, found = replayed(text, "first")
    assert (found, first) == (0, plain)
    again, more, found = replayed(text, "again")
    assert (more, found, again) == (0, computed, plain)
    for path in sorted(Path("kept/parts").rglob("*.arrows"))[::3]:
        path.unlink()
    half, more, found = replayed(text, "half")
    assert more > 0
    assert (more + found, half) == (computed, plain)


def test_what_is_added_is_computed_and_nothing_else(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """64 runs a part, two logs, three configurations."""
    monkeypatch.setattr(parts_module, "MOST_RUNS", 64)
    assert replayed(study(), "out")[1:] == (2 * 3 * 3, 0)
    more, computed, found = replayed(study(gnn=True), "out")
    assert (computed, found) == (2 * 3, 18)
    assert more == replayed(study(gnn=True), "fresh", None)[0]
    raised, computed, found = replayed(study(runs=300), "out")  # the part that was cut, and two more
    assert (computed, found) == (2 * 3 * 3, 2 * 3 * 2)
    assert raised == replayed(study(runs=300), "fresh", None)[0]
    assert replayed(study(runs=128), "out")[1:] == (0, 2 * 3 * 2)
    assert replayed(study().replace("coPEM:", "renamed:"), "out")[1:] == (0, 18)
    third = study("logs: [a.mcap, b.mcap, c.mcap]")
    drive(here / "c.mcap")
    assert replayed(third, "out")[1:] == (9, 18)
    assert replayed(study("seed: 2"), "out")[1:] == (18, 0)
    assert replayed(study("window_s: [0, 2.5]"), "out")[1:] == (18, 0)
    assert replayed(study().replace("latency_s: 0.5", "latency_s: 0.4"), "out")[1:] == (6, 12)
    drive(here / "b.mcap", host=None)
    assert replayed(study("ego: '1'"), "out")[2] == 0


def test_what_comes_by_a_link_has_columns_that_parts_of_others_have_not(here: Path) -> None:
    """Those of the others are the same with and without it beside them."""
    linked = study(LINKS, runs=5).replace("measure:", RADIO)
    beside = replayed(linked, "beside", "kept")
    of_all = {path.name: path.read_bytes() for path in Path("kept/parts").rglob("*.arrows")}
    assert replayed(study(runs=5), "alone", "other")[1:] == (6, 0)
    alone = {path.name: path.read_bytes() for path in Path("other/parts").rglob("*.arrows")}
    assert alone.items() <= of_all.items()
    assert replayed(linked, "again", "other") == (beside[0], 4, 6)


def test_a_finished_study_is_resumed_without_reading_a_log(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty names of one recording, in two configurations."""
    for k in range(30):
        (here / f"name{k}.mcap").hardlink_to(here / "a.mcap")
    text = study("logs: [name*.mcap]", "measure: {onset: {kind: in_range, range_m: 60}, accuracy: false}", runs=3)
    first, computed, _ = replayed(text, "first")
    assert computed == 30 * 3

    def unread(*given: Any, **keys: Any) -> None:
        raise AssertionError("a log was read")

    monkeypatch.setattr(validate, "read_log", unread)
    again, computed, found = replayed(text, "again")
    assert (computed, found, again) == (0, 90, first)


def test_a_log_that_is_shown_is_read_again_and_no_other(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = study("show: {run: worst, logs: [b]}", runs=3)
    first, _, _ = replayed(text, "first")
    names, read = [], validate.read_log
    monkeypatch.setattr(validate, "read_log", lambda *a, **k: names.append(k["name"]) or read(*a, **k))
    again, _, _ = replayed(text, "again")
    assert names == ["b"]
    assert again == first
    assert "replay/b.mcap" in again


def test_parts_that_are_kept_are_nowhere_else(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results are written from them."""
    plain, _, _ = replayed(study(runs=5), "plain", None)
    monkeypatch.setattr(study_tables.tempfile, "TemporaryFile", None)
    assert replayed(study(runs=5), "out")[0] == plain


@pytest.mark.parametrize("damage", [Path.unlink, lambda part: part.write_bytes(part.read_bytes()[:-1])])
def test_a_part_that_goes_while_results_are_written_is_a_line(here: Path, damage: Any) -> None:
    Path("e.yaml").write_text(study(runs=5))
    result = cr.run("e.yaml", jobs=2, pieces="kept")
    part = sorted(Path("kept/parts").rglob("*.arrows"))[0]
    damage(part)
    with pytest.raises(InputError) as refused:
        result.save("out")
    assert str(refused.value) == (
        f"--pieces: {part}: expected the part that was there before, found none, or a damaged one; "
        "run the command again"
    )
    assert not Path("out").exists()
    cr.run("e.yaml", jobs=2, pieces="kept").save("out")


def test_what_is_damaged_is_computed_again(here: Path) -> None:
    text = study(runs=5)
    whole, _, _ = replayed(text, "whole")
    rng, places = np.random.default_rng(1), sorted(Path("kept/parts").rglob("*.arrows"))
    for place in places[:2]:
        before = place.read_bytes()
        for at in [*rng.integers(0, len(before), 5).tolist(), None]:
            content = bytearray(before)
            if at is None:
                content = content[: len(content) // 2]
            else:
                content[at] ^= 1 << int(rng.integers(8))
            place.write_bytes(content)
            found, again, _ = replayed(text, "out")
            assert found == whole, (place, at)
            assert again <= 1
            place.write_bytes(before)
    result = cr.run("e.yaml", pieces="kept")
    assert result.study.logs[0].parts.damaged == []  # type: ignore[union-attr]
    places[0].write_bytes(b"no Parquet")
    store = cr.run("e.yaml", pieces="kept").study.logs[0].parts
    assert store is not None
    assert re.fullmatch(r"kept/parts/../[0-9a-f.]+arrows: damaged, computed again \(.*\)", store.damaged[0])


def test_a_record_of_a_log_that_nests_without_end_is_as_none(here: Path) -> None:
    """The log is read again, and the record written anew."""
    first, _, _ = replayed(study(runs=3), "first")
    records = {path: path.read_bytes() for path in Path("kept/logs").iterdir()}
    for path in records:
        path.write_bytes(b"[" * 100_000)
    again, computed, found = replayed(study(runs=3), "again")
    assert (computed, found, again) == (0, len(list(Path("kept/parts").rglob("*.arrows"))), first)
    assert {path: path.read_bytes() for path in Path("kept/logs").iterdir()} == records


@pytest.mark.parametrize("deep", [200, 100_000])
def test_a_part_whose_sums_nest_without_end_is_computed_again(here: Path, deep: int) -> None:
    """One whose digest is right: it was made so."""
    whole, _, _ = replayed(study(runs=5), "whole")
    place = min(Path("kept/parts").rglob("*.arrows"))
    reader = pa.BufferReader(place.read_bytes().partition(b"\n")[2])
    tables = []
    while reader.tell() < reader.size():
        tables.append(ipc.open_stream(reader).read_all())
    recipe = tables[0].schema.metadata[b"about"]
    stream = pa.BufferOutputStream()
    for table in (
        tables[0].replace_schema_metadata({b"about": recipe, b"total": b"[" * deep + b"]" * deep}),
        *tables[1:],
    ):
        with ipc.new_stream(stream, table.schema) as writer:
            writer.write_table(table)
    content = stream.getvalue().to_pybytes()
    place.write_bytes(hashlib.blake2b(content, digest_size=20).hexdigest().encode() + b"\n" + content)
    store = cr.run("e.yaml", pieces="kept").study.logs[0].parts
    assert store is not None
    (note,) = store.damaged
    assert note.startswith(f"{place}: damaged, computed again (")
    assert "values within values" in note
    assert replayed(study(runs=5), "again")[0] == whole


@pytest.mark.parametrize(
    ("runs", "states", "expected"),
    [
        (10, 1, [0, 10]),
        (600, 1, [0, 256, 512, 600]),
        (600, 20_000, [0, 128, 256, 384, 512, 600]),  # 209 runs have 2²² states; 128 is the power of two below
        (5, 1_200_000, [0, 2, 4, 5]),
        (3, 10_000_000, [0, 1, 2, 3]),
        (3, 0, [0, 3]),
    ],
)
def test_runs_of_parts(runs: int, states: int, expected: list[int]) -> None:
    found = cut_parts(runs, states)
    assert [begin for begin, _ in found] + [runs] == expected
    assert [end for _, end in found] == expected[1:]


def test_where_nothing_can_be_kept(here: Path) -> None:
    Path("e.yaml").write_text(study())
    with pytest.raises(InputError, match=r"^--pieces: drives://here: expected a protocol of s3"):
        cr.run("e.yaml", pieces="drives://here")
    with pytest.raises(OutputError, match=r"^--pieces: a.mcap: cannot be written: Not a directory$"):
        cr.run("e.yaml", pieces="a.mcap")


def test_a_long_log_in_stretches_has_the_parts_of_each_configuration_alone(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stretches reach back as far as any configuration needs: parts of one alone are those among others."""
    from copem_replay.pipeline import prepare as chunking

    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 20)
    text = study(runs=6, gnn=True)
    plain, _, _ = replayed(text, "plain", None)
    lines = text.splitlines()
    for name in ("PEM", "coPEM", "gnn"):
        alone = [line for line in lines if "{units" not in line or line.startswith(f"  {name}:")]
        assert replayed("\n".join(alone), "alone")[1:] == (2, 0)
    again, computed, found = replayed(text, "again")
    assert (computed, found, again) == (2, 2 * 3, plain)


_FUSED = study(LINKS, runs=40, gnn=True).replace("measure:", RADIO)
_FLEET = study(FLEET, "sweep: {penetration_rate: [0, 0.3]}")


@pytest.mark.parametrize(
    ("text", "many", "kept"),
    [(_FUSED, False, "kept"), (_FUSED, True, None), (_FLEET, False, None), (_FLEET, True, "kept")],
    ids=["fused, one file, kept", "fused, a file per log", "fleet, one file", "fleet, a file per log, kept"],
)
def test_few_parts_are_in_memory_at_a_time(
    text: str, many: bool, kept: str | None, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They wait in a file to be written: the same bytes however many are taken at a time, of row groups, too."""
    monkeypatch.setattr(table_files, "ROWS_A_GROUP", 100)
    if many:
        monkeypatch.setattr(results_write, "MANY_ROWS", 10)
    for name in "cd":
        (here / f"{name}.mcap").hardlink_to("a.mcap")
    text = text.replace("logs: [a.mcap, b.mcap]", "logs: ['?.mcap']")
    plain, _, _ = replayed(text, "plain", None)
    assert len([name for name in plain if name.startswith("detections.parquet")]) == (4 if many else 1)
    monkeypatch.setattr(parts_module, "MOST_RUNS", 16)
    for name, value in {"BATCH_ROWS": 1, "BATCH_BYTES": 1}.items():
        monkeypatch.setattr(study_tables, name, value)
    packed, read, most = [], [], [0]
    pack, unpack = study_tables.pack_part, study_tables.unpack_part
    for module in (study_tables, parts_module):  # where they wait in a file without a name, and where they are kept
        monkeypatch.setattr(module, "pack_part", lambda *a: [packed.append(1), pack(*a)][1])
        monkeypatch.setattr(module, "unpack_part", lambda *a: [read.append(1), unpack(*a)][1])
    frame = study_tables.StudyTables.frame

    def watched(self: Any, parts: Any) -> Any:
        parts = list(parts)
        most.append(sum(part.beside is not None for part in parts))
        return frame(self, parts)

    monkeypatch.setattr(study_tables.StudyTables, "frame", watched)
    first, computed, _ = replayed(text, "first", kept)
    assert first == plain
    assert 4 < len(read) <= len(packed)  # parts of swept points are kept, too, and not read again
    assert max(most) == 1
    if kept is not None:
        assert replayed(text, "again", kept) == (plain, 0, computed)
