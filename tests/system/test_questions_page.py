"""The page of questions: each answer is an experiment once its keys are added, and fits the recording it names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

import copem_replay as cr
from copem_replay.experiment.file import read_experiment_file
from copem_replay.experiment.validate import find_problems

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/guide/questions.md").read_text(encoding="utf-8")
QUESTIONS = re.split(r"^### ", PAGE, flags=re.MULTILINE)
NAMED = {"pems", "units", "links", "areas", "configurations", "criteria", "measure"}


def yaml_in(text: str) -> Iterator[dict[str, Any]]:
    for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL):
        yield YAML(typ="safe").load(block)


def added(base: dict[str, Any], answer: dict[str, Any]) -> dict[str, Any]:
    """What the page says: keys are added under their sections, what has the same name is replaced."""
    return base | {
        key: base.get(key, {}) | value if key in NAMED else value  # a section of names, or a value
        for key, value in answer.items()
    }


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "logs").symlink_to(ROOT / "logs")
    return tmp_path


def test_there_are_twenty_questions_each_with_its_keys() -> None:
    titles = [question.splitlines()[0] for question in QUESTIONS[1:]]
    assert [title.split(". ")[0] for title in titles] == [str(k) for k in range(1, 21)]
    assert all(title.endswith("?") for title in titles)
    for question in QUESTIONS:
        assert len(list(yaml_in(question))) == 1, question[:40]


@pytest.mark.parametrize("question", QUESTIONS, ids=lambda text: text.splitlines()[0])
def test_an_answer_is_an_experiment(place: Path, question: str) -> None:
    (base,) = yaml_in(QUESTIONS[0])
    (answer,) = yaml_in(question)
    path = place / "experiment.yaml"
    with path.open("w", encoding="utf-8") as file:
        YAML().dump(added(base, answer), file)
    source = read_experiment_file(path)
    experiment, problems = find_problems(source)
    assert problems == []
    assert experiment is not None
    if "<!-- needs topics of your own -->" not in question:
        assert len(cr.read_recordings(path)) == 1  # else all problems of both together
