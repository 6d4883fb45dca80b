"""The area of an episode, and groups by it; places by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.core.errors import InputError
from copem_replay.metrics.config import parse_slice
from copem_replay.metrics.slices import number_groups
from copem_replay.results.read import read_results
from copem_replay.results.slices import read_slices, read_study_rows
from tests.helpers.recordings import Obj, pedestrian, write_recording

ROAD = """<OpenDRIVE><header/><road id="7" length="200" junction="-1"><planView>
<geometry s="0" x="-50" y="0" hdg="0" length="200"><line/></geometry></planView><lanes><laneSection s="0">
<right><lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></right></laneSection></lanes>
<objects><object id="3" type="crosswalk" s="70" t="0" zOffset="0" hdg="0" length="4" width="12"/></objects>
</road></OpenDRIVE>"""
SCHOOL = {"polygon_m": [[19, 3], [40, 3], [40, 9], [19, 9]]}
PEOPLE = {"2": (20.0, 5.0), "3": (20.0, -5.0), "4": (30.0, 5.0), "5": (30.0, -5.0)}
"""On the crosswalk and in the school's area, on the crosswalk, in the area, in none."""


@pytest.fixture
def study(tmp_path: Path) -> dict[str, Any]:
    people = [pedestrian(int(name), x, y, vx=0.1) for name, (x, y) in PEOPLE.items()]
    for log in ("drive", "elsewhere"):
        frames = [(0.1 * k, [Obj(id=1, x=0.0, y=-2.0), *people]) for k in range(11)]
        write_recording(tmp_path / f"{log}.mcap", frames, host=1)
    (tmp_path / "town.xodr").write_text(ROAD)
    first = {"file": str(tmp_path / "drive.mcap"), "maps": [{"file": str(tmp_path / "town.xodr"), "frame": "same"}]}
    return {
        "version": 1, "logs": [first, str(tmp_path / "elsewhere.mcap")], "runs": 2, "show": None,
        "pems": {"sure": [{"detection": {"kind": "visible_share"}}]},
        "units": {"ego": {"on": "ego", "height_m": 1.5, "pem": "sure"}}, "configurations": {"a": {"units": ["ego"]}},
        "measure": {"onset": {"kind": "in_range", "range_m": 100}, "began": ["log_start"]},
    }  # fmt: skip


def areas_of(results: cr.Results) -> dict[tuple[str, str], str | None]:
    rows = results.tally.astype(object)
    named = zip(rows["log"], rows["object_id"], rows["area"].where(rows["area"].notna(), None), strict=True)
    return {(str(log), str(key)): area for log, key, area in named}


@pytest.mark.extras
def test_ones_own_come_first_and_a_log_without_a_map_has_none_of_it(study: dict[str, Any], tmp_path: Path) -> None:
    given = study | {"areas": {"school": SCHOOL}, "measure": study["measure"] | {"by": ["area"]}}
    results = cr.run(cr.load_experiment(given), jobs=1)
    of_both = {"2": "school", "4": "school", "5": None}
    expected = {(log, key): area for log in ("drive", "elsewhere") for key, area in of_both.items()}
    assert areas_of(results) == expected | {("drive", "3"): "crosswalk", ("elsewhere", "3"): None}
    assert results.summary_by is not None
    assert dict(zip(results.summary_by["group"], results.summary_by["objects"], strict=True)) == {
        "crosswalk": 1, "school": 4, "(no area)": 3,
    }  # fmt: skip
    results.save(tmp_path / "out")
    again = read_results(tmp_path / "out")
    assert areas_of(again) == areas_of(results)
    assert [group.label for group in read_study_rows(again).split(parse_slice("area"))] == [
        "crosswalk",
        "school",
        "(no area)",
    ]


def test_without_areas_there_is_no_such_column_and_no_slice(study: dict[str, Any]) -> None:
    given = study | {"logs": study["logs"][1:]}
    results = cr.run(cr.load_experiment(given), jobs=1)
    assert "area" not in results.tally
    with pytest.raises(InputError, match=r"--by: area: expected areas to group by, found none; name them with"):
        read_slices(results, ["area"])
    with pytest.raises(InputError, match=r"area: expected areas to group by, found none"):
        cr.run(cr.load_experiment(given | {"measure": study["measure"] | {"by": ["area"]}}), jobs=1)


def test_groups_are_in_order_of_their_names_and_none_comes_last() -> None:
    table = pd.DataFrame({"area": ["b", None, "a", float("nan")]})
    number, names = number_groups(table, parse_slice("area"), {})
    assert (number.tolist(), names) == ([1, 2, 0, 2], [("a",), ("b",), ("(no area)",)])
