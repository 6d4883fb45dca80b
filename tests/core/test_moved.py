"""Old import paths answer with the new ones."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import copem_replay as cr
from copem_replay.core.moved import MOVED, put_up_signposts
from tests.helpers.experiments import changed, drive


@pytest.mark.parametrize("old", MOVED)
def test_every_new_name_is_public(old: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=rf"^{old} has moved; `import copem_replay as cr` has ") as failure:
        importlib.import_module(old)
    for name in str(failure.value).partition(" has ")[2].rpartition(" has ")[2].split(", "):
        assert getattr(cr, name) is not None


def test_what_was_in_a_package_is_found_by_the_package() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"^copem_replay\.pem has moved; .*DetectionModel"):
        importlib.import_module("copem_replay.pem.detection")


def test_there_is_one_signpost_however_often_it_is_put_up() -> None:
    before = list(sys.meta_path)
    put_up_signposts()
    assert sys.meta_path == before


def test_what_never_was_there_is_not_found_as_ever() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"^No module named 'copem_replay\.nothing'$"):
        importlib.import_module("copem_replay.nothing")


def test_an_experiment_that_names_an_old_model_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "old_model.py").write_text("from copem_replay.pem.detection import DetectionModel\n")
    (tmp_path / "e.yaml").write_text(changed("      detection: {kind: 'old_model:Mine'}"))
    monkeypatch.syspath_prepend(tmp_path)
    load: Callable[[Path], object] = cr.load_experiment
    with pytest.raises(
        cr.ExperimentError, match=r"e\.yaml:\d+: .*copem_replay\.pem has moved; .* \(.*old_model\.py:1\)"
    ):
        load(tmp_path / "e.yaml")
