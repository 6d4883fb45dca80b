"""What docs/guide/ci.md says to type: its job on the recordings of the repo, its files of criteria, and the action."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from junitparser import JUnitXml

from copem_replay.cli import main as cli
from copem_replay.core.yaml import parse_yaml
from copem_replay.experiment.criteria import CriteriaFile
from copem_replay.experiment.cross_references import read_criteria

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/guide/ci.md").read_text(encoding="utf-8")
YAML, SHELL = (re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL) for kind in ("yaml", "sh"))
RUNS = 200
"""Of the page's 500: enough for its criteria."""


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repo with the recordings and the first file of criteria."""
    folder = tmp_path_factory.mktemp("repo")
    (folder / "logs").mkdir()
    shutil.copy(ROOT / "logs/tc016d.mcap", folder / "logs")
    text = (ROOT / "logs/tc016d.yaml").read_text(encoding="utf-8")
    (folder / "logs/tc016d.yaml").write_text(re.sub(r"^runs: 500", f"runs: {RUNS}", text, flags=re.MULTILINE))
    (folder / "limits.yaml").write_text(YAML[0])
    return folder


def typed(command: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """A command of the page in this process: its exit code, and what it prints."""
    words = shlex.split(command)
    assert words[0] == "copem-replay"
    code = cli._call_command(words[1:])
    return code, capsys.readouterr().out


def test_the_job_runs_as_it_stands(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(here)
    job, against, past = ([line for line in block.splitlines() if line] for block in SHELL)
    assert [line.split()[1] for line in (*job, *against, *past)] == ["check", "run", "verdict", "compare", "history"]
    for command in job:
        code, out = typed(command, capsys)
        assert code == 0, command
    assert "3 of 3 verdicts pass: 3 met" in out
    assert len(list(*JUnitXml.fromfile("out/verdicts.xml"))) == 3
    assert Path("out/verdicts.md").read_text().count("\n| ") == 4
    typed(job[1].replace("out/new", "out/before"), capsys)
    typed(job[2].replace("out/new", "out/before"), capsys)
    code, out = typed(against[0], capsys)
    assert code == 0, out
    assert out.splitlines()[-1] == "new against before: nothing changed: PEM, coPEM:0s, coPEM:0.5s and 2 more"
    assert typed(past[0], capsys)[0] == 0
    assert "the ego brakes in time" in Path("out/history.html").read_text()


def test_a_limit_that_is_broken_fails_after_all_is_written(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(here)
    strict = tmp_path / "strict.yaml"
    strict.write_text(YAML[0].replace("at_most: 0.5", "at_most: 0.4"))
    command = f"copem-replay verdict out/new --criteria {strict} --junit {tmp_path}/v.xml --jsonl {tmp_path}/v.jsonl"
    code, out = typed(command, capsys)
    assert code == 1
    assert "2 of 3 verdicts pass: 2 met, 1 not met" in out
    assert (JUnitXml.fromfile(str(tmp_path / "v.xml")).failures, (tmp_path / "v.jsonl").is_file()) == (1, True)


def test_its_files_of_criteria_are_right() -> None:
    source = {"configurations": {"PEM": {}, "coPEM:0.5s": {}}, "braking": {}}
    assert len(read_criteria(parse_yaml(YAML[0])[0]["criteria"], source)) == 3
    assert len(CriteriaFile.model_validate(parse_yaml(YAML[1])[0]).criteria) == 2


def test_the_action_runs_and_judges_and_writes_the_summary(here: Path, tmp_path: Path) -> None:
    action = parse_yaml((ROOT / "action.yml").read_text(encoding="utf-8"))[0]
    used = parse_yaml(YAML[2])[0]["jobs"]["replay"]["steps"][2]["with"]
    assert used.keys() <= action["inputs"].keys()
    step = action["runs"]["steps"][1]
    # Inputs come as variables: a text of somebody else's is never part of a script.
    assert "${{" not in step["run"]
    given = {name: str(of.get("default", "")) for name, of in action["inputs"].items()} | used | {"label": "a b"}
    variables = {name: given[re.fullmatch(r"\$\{\{ inputs\.(\w+) \}\}", of)[1]] for name, of in step["env"].items()}  # type: ignore[index]
    command = tmp_path / "copem-replay"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m copem_replay.cli.main "$@"\n')
    command.chmod(0o755)
    summary = tmp_path / "summary.md"
    path = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT), "GITHUB_STEP_SUMMARY": str(summary)}
    done = subprocess.run(["bash", "-e", "-c", step["run"]], cwd=here, env=os.environ | variables | path, check=False,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "3 of 3 verdicts pass" in summary.read_text()
    assert (here / "out/new/verdicts.xml").is_file()
    assert (here / "out/new/report.html").is_file()
    before = variables | {"BEFORE": "out/before", "CRITERIA": ""}
    shutil.copytree(here / "out/new", here / "out/before", dirs_exist_ok=True)
    done = subprocess.run(["bash", "-e", "-c", step["run"]], cwd=here, env=os.environ | before | path, check=False,
                          capture_output=True, text=True)  # fmt: skip
    assert summary.read_text().splitlines()[-2].startswith("new against before: nothing changed: "), done.stderr
    broken = variables | {"CRITERIA": "nowhere.yaml"}
    done = subprocess.run(["bash", "-e", "-c", step["run"]], cwd=here, env=os.environ | broken | path, check=False,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 2
