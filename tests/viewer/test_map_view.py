"""The map view is written where it is asked for, at the places on earth; else nothing of the file changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from copem_replay.core.frame import Frame, make_local_proj
from copem_replay.viewer.rrd import write_rrd
from tests.viewer.test_rrd import CHANGES, SUMMARY, Made, approaching, at, chunks, make, static

FRAME = Frame(make_local_proj(48.0, 11.0), (100.0, -50.0), 0.3)


def placed() -> object:
    recording = approaching()
    return replace(recording, scene=replace(recording.scene, frame=FRAME))


def entities(path: Path) -> list[str]:
    return [name for name in ("/map/truth", "/map/solids", "/map/units") if any(chunks(path, name))]


def views(path: Path) -> set[str]:
    """The kinds of views of the layout."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    [blueprint] = reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=blueprint)]
    column = "ViewBlueprint:class_identifier"
    return {batch.column(column)[0].as_py()[0] for batch in batches if column in batch.schema.names}


def made(path: Path, scene: object, **changes: object) -> Made:
    house = {"polygon_m": [[0, 20], [4, 20], [4, 23]], "height_m": 2.0}
    return make(path / "replay.rrd", scene, **CHANGES | {"obstacles": [house]} | changes)


def test_objects_units_and_solids_are_where_they_are_on_earth(tmp_path: Path) -> None:
    shown = made(tmp_path, placed(), show={"map": True})
    assert "Map" in views(shown.path)
    truth = shown.replay.truth
    rows = np.flatnonzero(truth.valid[0] & (np.abs(truth.row_captured_s - 1.0) < 1e-9))
    at_m = np.stack([truth.x_m[0, rows], truth.y_m[0, rows]], axis=1)
    found = np.array(at(shown.path, "/map/truth", 1.0)["GeoPoints:positions"])
    assert len(rows) == 4
    assert found == pytest.approx(FRAME.to_wgs84(at_m), abs=1e-9)
    (outline,) = static(shown.path, "/map/solids")["GeoLineStrings:line_strings"]
    assert np.array(outline) == pytest.approx(FRAME.to_wgs84([(0, 20), (4, 20), (4, 23), (0, 20)]), abs=1e-9)
    standing = [unit.at for unit in shown.given.units.values() if unit.at is not None]
    units = np.array(static(shown.path, "/map/units")["GeoPoints:positions"])
    assert units == pytest.approx(FRAME.to_wgs84(standing), abs=1e-9)


def test_no_map_where_it_is_not_asked_for(tmp_path: Path) -> None:
    """The viewer asks a foreign host for tiles as soon as there is such a view."""
    shown = made(tmp_path, placed())
    assert entities(shown.path) == []
    assert "Map" not in views(shown.path)
    assert shown.given.show is not None
    assert "map" not in shown.given.show.model_dump()


def test_without_a_place_there_is_no_map_and_a_note(tmp_path: Path) -> None:
    shown = made(tmp_path, approaching(), show={"map": True})
    assert entities(shown.path) == []
    assert "Map" not in views(shown.path)
    notes = write_rrd(tmp_path / "x.rrd", shown.replay, shown.given, [shown.run_tracks], shown.table, SUMMARY, 3)
    assert notes[0] == "no map view: it is not known where the log is on earth; write `frame: {proj: …}`"
