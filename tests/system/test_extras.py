"""Core and extras: one table finds each extra, and the core does its job where their folder is not there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

import copem_replay as cr
from copem_replay.core.extras import EXTRAS, load_extra
from tests.helpers.experiments import TEXT, drive

ROOT = Path(__file__).parents[2]
OFFERS = [(kind, name) for kind, names in EXTRAS.items() for name in names]
Core = Callable[..., tuple[int, list[str]]]


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Core:
    """The command of a copy of the package without its extras, in a folder with a drive: exit code, lines of errors."""
    place = tmp_path_factory.mktemp("core")
    copied = shutil.ignore_patterns("extras")  # with what is compiled
    shutil.copytree(ROOT / "copem_replay", place / "copem_replay", ignore=copied)
    here = place / "here"
    here.mkdir()
    drive(here / "drive.mcap")
    (here / "e.yaml").write_text(TEXT)
    code = f"import sys; sys.path.insert(0, {str(place)!r}); from copem_replay.cli.main import main; main()"

    def call(*words: str) -> tuple[int, list[str]]:
        done = subprocess.run([sys.executable, "-c", code, *words], cwd=here, capture_output=True, text=True)
        passing = ("note: ", "replaying: ")
        return done.returncode, [line for line in done.stderr.splitlines() if not line.startswith(passing)]

    return call


@pytest.mark.long
def test_the_quick_tests_pass_without_extras(tmp_path: Path) -> None:
    """In a copy of the project: those of extras are not collected, those of the core that use one are skipped."""
    copy = tmp_path / "copy"
    ignored = shutil.ignore_patterns(".git", ".venv*", ".*_cache", ".hypothesis", "out", "*.egg-info")
    shutil.copytree(ROOT, copy, ignore=ignored)  # with what is compiled
    shutil.rmtree(copy / "copem_replay/extras")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-m", "not slow and not long"]
    done = subprocess.run(
        command, cwd=copy, env=environment | {"PYTHONPATH": str(copy)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-5000:]


@pytest.mark.extras
@pytest.mark.parametrize(("kind", "name"), OFFERS, ids=[f"{kind}: {name}" for kind, name in OFFERS])
def test_what_the_table_names_is_there(kind: str, name: str) -> None:
    assert callable(load_extra(kind, name))


@pytest.mark.extras
def test_every_extra_is_in_the_table() -> None:
    folders = {path.name for path in (ROOT / "copem_replay/extras").iterdir() if (path / "__init__.py").is_file()}
    assert {place.partition(".")[0] for names in EXTRAS.values() for place in names.values()} == folders


@pytest.mark.extras
def test_names_of_the_api_are_those_of_the_table() -> None:
    for name, place in EXTRAS["name of the API"].items():
        module, _, attribute = place.partition(":")
        assert getattr(cr, name) is getattr(import_module(f"copem_replay.extras.{module}"), attribute)
        assert name in cr.__all__
    assert cr.plot.write_film is cr.write_film, "its name of before"


def test_the_core_replays_compares_and_reports_without_extras(core: Core, tmp_path: Path) -> None:
    assert core("check", "e.yaml") == (0, [])
    assert core("run", "e.yaml", "--out", str(tmp_path / "out"), "--report") == (0, [])
    assert core("compare", str(tmp_path / "out")) == (0, [])
    assert core("plot", str(tmp_path / "out")) == (0, [])
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert 'id="table"' in page
    assert not [name for name in EXTRAS["section of the report"] if f'id="{name}"' in page]


@pytest.mark.parametrize("name", EXTRAS["command"])
def test_a_command_whose_extra_is_not_there_says_so(core: Core, name: str) -> None:
    extra = EXTRAS["command"][name].partition(".")[0]
    said = f"command {name}: expected copem_replay/extras/{extra}, found an installation without it"
    assert core(name, "x", "--out", "y") == (2, [f"{said}; install copem-replay whole"])


def test_a_map_and_a_crew_without_their_extras_are_refused_in_a_line(core: Core, tmp_path: Path) -> None:
    (tmp_path / "site.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    drive(tmp_path / "drive.mcap")
    (tmp_path / "map.yaml").write_text(f"{TEXT}\nmaps: [{{file: site.geojson}}]\n")
    code, [line] = core("run", str(tmp_path / "map.yaml"), "--out", str(tmp_path / "out"))
    assert code == 2
    assert "reader map: expected copem_replay/extras/maps, found an installation without it" in line
    code, [line] = core("run", "e.yaml", "--cluster", "local:2", "--out", str(tmp_path / "out"))
    assert code == 2
    assert "expected copem_replay/extras/cluster, found an installation without it" in line
    assert not (tmp_path / "out").exists()
