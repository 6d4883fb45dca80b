"""The documentation is true: its commands run, its output is real, its experiments load, its links lead somewhere."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import copem_replay as cr
from copem_replay.communication.link import UnitLinks, transmit
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.file import parse_experiment, read_experiment_file
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.interface import StepFusion
from copem_replay.fusion.testing import check_fusion
from copem_replay.perception.pem.detection import DetectionModel
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from tests.helpers import scenes
from tests.helpers.scenes import experiment

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from page_outputs import renew_outputs
from processor import IS_X86, plain_environment

ROOT = Path(__file__).parents[2]
on_x86 = pytest.mark.skipif(not IS_X86, reason="pages are written on x86-64: other processors round otherwise")
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(ROOT.glob("docs/**/*.md"))]
WITH_OUTPUTS = [page for page in PAGES if "<!-- output: " in page.read_text(encoding="utf-8")]


def test_the_readme_begins_with_what_it_is_and_how_it_looks() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    headings = [k for k, line in enumerate(lines) if line.startswith("#")]
    picture = next(k for k, line in enumerate(lines) if line.startswith("!["))
    assert picture < headings[1] < 20, "on the first screen"


@pytest.mark.long
@on_x86
@pytest.mark.parametrize("page", WITH_OUTPUTS, ids=lambda page: page.name)
def test_pages_show_what_their_commands_print(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text.count("<!-- output: ") == len(re.findall(r"<!-- output: .*? -->\n```text\n.", text)), "a block each"
    assert renew_outputs(text) == text


def test_the_own_reception_of_the_links_page_keeps_the_rules() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/guide/links.md").read_text(encoding="utf-8"), re.DOTALL)
    exec(code, {"__name__": "page"})


@on_x86
@pytest.mark.long
def test_the_study_from_raw_bags_prints_what_its_page_says(tmp_path: Path) -> None:
    """Each command of the page in turn; its experiment is written where it stands; `…` in a block: lines left out."""
    for name in ("logs", "tools"):
        (tmp_path / name).symlink_to(ROOT / name)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    page, printed = (ROOT / "docs/guide/study.md").read_text(encoding="utf-8"), ""
    for kind, block in re.findall(r"```(\w+)\n(.*?)```", page, re.DOTALL):
        if kind == "yaml":
            (tmp_path / "study.yaml").write_text(block, encoding="utf-8")
        elif kind == "sh":
            for command in block.splitlines():
                done = subprocess.run(
                    command,
                    shell=True,
                    cwd=tmp_path,
                    env=plain_environment() | {"PATH": path},
                    capture_output=True,
                    text=True,
                )
                assert done.returncode == 0, (command, done.stderr)
                printed = done.stdout
        else:
            elided = ".*".join(re.escape(part) for part in re.split(r"^…\n", block, flags=re.MULTILINE))
            assert re.fullmatch(elided, printed, re.DOTALL), (block, printed)
    assert (tmp_path / "out/study/report.html").is_file()


def test_what_is_put_into_the_bags_is_in_the_intervals_of_the_study(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    put_in = importlib.import_module("study_bags")
    page = (ROOT / "docs/guide/study.md").read_text(encoding="utf-8")
    blocks = "".join(re.findall(r"```text\n(.*?)```", page, re.DOTALL))
    told = [tuple(map(float, found)) for found in re.findall(r" ([\d.-]+) s \(95 %: ([\d.-]+) … ([\d.-]+) s", blocks)]
    assert len(told) == 3
    true = (put_in.EGO_DELAY_S, put_in.STACK_AGE_S, put_in.CLOCK_AHEAD_S)
    for true_s, (found_s, low_s, high_s) in zip(true, told, strict=True):
        assert low_s < true_s < high_s
        assert low_s < found_s < high_s
    assert f"{put_in.CLOCK_AHEAD_S:g} s ahead" in page
    assert f"the state {put_in.EGO_DELAY_S:g} s before" in page
    assert f"of {put_in.STACK_AGE_S:g} s before" in page
    assert f"takes {put_in.RADIO_S:g} s" in page
    # By hand, in ms: the stack last heard the vehicle (10 Hz) or the unit (8 Hz from 30 ms), and publishes each 100 ms
    received = [*range(70, 60_000, 100), *range(30 + 90 + 100, 60_000, 125)]
    ages = [min(now - one for one in received if one <= now) for now in range(1000, 60_000, 100)]
    assert sum(ages) / len(ages) == pytest.approx(put_in.STACK_AGE_S * 1000, abs=0.1)


def test_experiments_on_the_page_load(tmp_path: Path) -> None:
    text = (ROOT / "docs/guide/experiment.md").read_text(encoding="utf-8")
    blocks = re.findall(r"<!-- experiment -->\n```yaml\n(.*?)```", text, re.DOTALL)
    assert blocks
    for k, block in enumerate(blocks):
        path = tmp_path / f"{k}.yaml"
        path.write_text(block, encoding="utf-8")
        experiment, problems = parse_experiment(read_experiment_file(path))
        assert problems == []
        assert isinstance(experiment, Experiment)


def test_python_of_the_experiment_page_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = (ROOT / "docs/guide/experiment.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (tmp_path / "logs").symlink_to(ROOT / "logs")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {"__name__": "page"}
    exec(code, namespace)
    assert isinstance(namespace["result"], cr.Results)
    assert len(namespace["result"].detections) == 3000
    assert (tmp_path / "out/python/summary.csv").is_file()
    assert len(namespace["comparison"]) > 0
    assert len(namespace["figure"].axes) > 0
    assert len(namespace["fused"]) > 0


def test_pages_and_notebooks_use_the_public_api_alone() -> None:
    text = (ROOT / "docs/guide/experiment.md").read_text(encoding="utf-8")
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    for path in sorted(ROOT.glob("notebooks/*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code += ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    whole = "\n".join(code)
    assert re.findall(r"(?:from|import) copem_replay.*", whole) == ["import copem_replay as cr"] * 7
    used = set(re.findall(r"\bcr\.(\w+)", whole))
    assert used <= set(cr.__all__)
    assert set(re.findall(r"\bcr\.plot\.(\w+)", whole)) <= set(cr.plot.__all__)


@pytest.fixture
def architecture(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The Python of the architecture page, as the module `page`."""
    text = (ROOT / "docs/develop/architecture.md").read_text(encoding="utf-8")
    page = ModuleType("page")
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(code, vars(page))
    monkeypatch.setitem(sys.modules, "page", page)
    return page


def test_own_model_of_the_architecture_page_works(architecture: ModuleType) -> None:
    fading = architecture.Fading
    assert isinstance(fading, type)
    assert issubclass(fading, DetectionModel)
    one = np.ones(1)
    episode = ViewGeometry(one * 20, one, one, one, np.zeros(1, dtype=np.int8), one, one, one, one, one)
    assert fading(kind="page:Fading", half_range_m=20.0).probability(episode) == pytest.approx(0.5)


def test_own_error_model_of_the_architecture_page_works(architecture: ModuleType) -> None:
    couple = {"detection": {"kind": "page:Fading", "half_range_m": 1e9}}
    plan = experiment(pems={"sure": [couple | {"error": {"kind": "page:Widening", "sigma_m_per_m": 0.1}}]})
    log = scenes.oncoming_car()
    fused = tracks_of_run(prepare_log(log, plan), plan, 0)["PEM"].fused
    rows = np.flatnonzero(fused.valid[0])
    away_m = 100.0 - 10.0 * fused.captured_s[fused.frame_ix[rows]]  # the car comes at 10 m/s along the x axis
    assert fused.cov_ee_m2 is not None
    assert fused.yaw_var_rad2 is not None
    assert fused.cov_ee_m2[0, rows] == pytest.approx((0.1 * away_m) ** 2)
    assert fused.yaw_var_rad2[0, rows] == pytest.approx(0.05**2)
    off_m = (fused.x_m[0, rows] - away_m) / (0.1 * away_m)
    assert 0.5 < np.std(off_m[away_m > 1]) < 1.5


def test_own_link_of_the_architecture_page_works(architecture: ModuleType) -> None:
    filling = architecture.Filling(kind="page:Filling", per_s=0.5)
    late = transmit(scenes.oncoming_car().truth, [UnitLinks("link", filling)])
    assert late.arrives_s[0, [0, 40, 80]] == pytest.approx([0.0, 6.0, 12.0])


def test_own_fusion_of_the_fusion_page_works() -> None:
    text = (ROOT / "docs/guide/fusion.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    namespace: dict[str, object] = {"__name__": "page"}
    exec(code, namespace)
    surest = namespace["Surest"]
    assert isinstance(surest, type)
    assert issubclass(surest, StepFusion)
    check_fusion(surest(kind="page:Surest"))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_within_the_project_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_components_of_the_adding_page_work(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs/develop/adding.md").read_text(encoding="utf-8")
    page = ModuleType("page")
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(code, vars(page))
    monkeypatch.setitem(sys.modules, "page", page)
    cr.check_latency(page.Uniform(kind="page:Uniform", most_s=0.3))
    measure = {"onset": {"kind": "page:Fast", "speed_mps": 9}, "metrics": [{"kind": "page:Late", "name": "late_share"}]}
    summary = cr.run(experiment(measure=measure), [scenes.oncoming_car()]).summary.set_index("configuration")
    assert summary["late_share"].to_dict() == {"GT": 0.0, "PEM": 1.0}  # 10 m/s from the first frame on, seen at 4 s


@pytest.mark.extras
def test_the_adding_page_names_what_is_there() -> None:
    text = (ROOT / "docs/develop/adding.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\d+) ", text, re.MULTILINE) == [str(k) for k in range(1, 12)]
    for name in re.findall(r"`((?:[a-z]\w*/)+(?:\w+\.py)?)`", text):
        assert (ROOT / name).exists() or (ROOT / "copem_replay" / name).exists(), name


def test_architecture_names_every_file() -> None:
    text = (ROOT / "docs/develop/architecture.md").read_text(encoding="utf-8")
    for path in (ROOT / "copem_replay").rglob("*.py"):
        name = path.relative_to(ROOT / "copem_replay").as_posix()
        folder = name.split("/")[0] + "/" if "/" in name else None
        assert path.name == "__init__.py" or name in text or (folder and f"`{folder}`" in text), name


def test_decisions_are_few_pages_and_code_names_those_that_are_there() -> None:
    pages = {path.stem: path.read_text(encoding="utf-8") for path in (ROOT / "docs/develop/decisions").glob("*.md")}
    assert len(pages) <= 20, "a page a wing, and those of what cuts across: a decision goes into one of them"
    assert sum(len(text.split()) for text in pages.values()) <= 8_000
    for folder in ("copem_replay", "tools", "tests"):
        for path in (ROOT / folder).rglob("*.py"):
            named = re.findall(r"docs/develop/decisions/([\w-]+)\.md", path.read_text(encoding="utf-8"))
            assert set(named) <= set(pages), path
