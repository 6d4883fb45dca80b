"""Results of an older format are refused in one line, by all that read them; an old key by its new name."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import copem_replay as cr
from tests.helpers.experiments import changed, drive


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results as version 0.1 wrote them: without a format."""
    place = tmp_path_factory.mktemp("older")
    drive(place / "drive.mcap")
    (place / "e.yaml").write_text(changed("show: {run: 0}"))
    folder = cr.run(place / "e.yaml").save(place / "old")
    said = json.loads((folder / "provenance.json").read_text())
    assert said.pop("format") == 6
    (folder / "provenance.json").write_text(json.dumps(said))
    return folder


@pytest.mark.parametrize(
    "name",
    [
        "load_results", "compare", "write_report", "view", "write_figures",
        pytest.param("write_film", marks=pytest.mark.extras),
    ],
)  # fmt: skip
def test_an_older_format_is_refused(older: Path, name: str) -> None:
    with pytest.raises(cr.InputError) as failure:
        getattr(cr, name)(older)
    again = "run the experiment again with --overwrite"
    assert failure.value.problems == (f"{older}: expected results of format 6, found format 1; {again}",)


@pytest.mark.parametrize("read", [cr.load_results, cr.compare])
def test_results_that_do_not_say_what_configurations_are_are_refused(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(changed())
    folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "old")
    said = json.loads((folder / "provenance.json").read_text())
    facts = said.pop("configurations")
    assert facts["GT"] == {
        "truth": True, "recorded": False, "by_truth_id": True, "fixed": True, "fixed_verdicts": False,
        "needs_visibility": False, "ideal": None, "ideal_of": None, "remembering": None, "least_s": 0.0,
    }  # fmt: skip
    (folder / "provenance.json").write_text(json.dumps(said))
    with pytest.raises(cr.InputError, match=r"no 'configurations'; run the experiment again with --overwrite$"):
        read(folder)


def test_they_are_replaced_where_that_is_asked_for(older: Path) -> None:
    cr.run(older.parent / "e.yaml").save(older, overwrite=True)
    assert len(cr.load_results(older).summary) == 3


def test_a_key_that_has_another_name_is_refused_with_it(tmp_path: Path) -> None:
    drive(tmp_path / "drive.mcap")
    fleet = "  mast: {on: {classes: [car], share: 0.5}, pem: onboard}"
    (tmp_path / "e.yaml").write_text(changed(fleet, "sweep: {share: [0, 1]}"))
    with pytest.raises(cr.ExperimentError) as failure:
        cr.load_experiment(tmp_path / "e.yaml")
    said = [line for line in failure.value.problems if "is called" in line]
    assert [line.partition("e.yaml:")[2] for line in said] == [
        "12: units.mast.on.share: `share` is called `penetration_rate` now",
        "19: sweep.share: `share` is called `penetration_rate` now",
    ]
