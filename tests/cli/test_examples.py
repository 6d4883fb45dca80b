"""Every public docstring has an example, and what it prints is what it shows."""

from __future__ import annotations

import doctest
import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import copem_replay as cr
from copem_replay.core.extras import EXTRAS

ROOT = Path(__file__).parents[2]
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def documented() -> Iterator[object]:
    """Names of all functions and classes of the API; `plot.sweeps` for those of its modules."""
    for name in cr.__all__:
        if name in EXTRAS["name of the API"]:
            yield pytest.param(name, marks=pytest.mark.extras)
            continue
        found = getattr(cr, name)
        if isinstance(found, ModuleType):
            yield from (f"{name}.{inner}" for inner in found.__all__)
        elif inspect.isclass(found) or inspect.isfunction(found):
            yield name


def docstrings(name: str) -> Iterator[tuple[str, str]]:
    """The docstring of a name, and of a class those of its own methods that have an example."""
    found = getattr(cr.plot, name.removeprefix("plot."), None) if "." in name else getattr(cr, name)
    assert found.__doc__, name
    yield name, inspect.cleandoc(found.__doc__)
    for inner, member in vars(found).items() if inspect.isclass(found) else ():
        text = member.__doc__ or "" if inspect.isfunction(member) and not inner.startswith("_") else ""
        if ">>>" in text:
            yield f"{name}.{inner}", inspect.cleandoc(text)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recordings of the project, and the results of one experiment."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "logs").symlink_to(ROOT / "logs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        cr.run("logs/tc016d.yaml").save("out/tc016d")
    return folder


@pytest.mark.parametrize("name", [*documented()])
def test_examples(name: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    names = {"cr": cr, "np": np}
    said: list[str] = []
    for number, (where, text) in enumerate(docstrings(name)):
        test = doctest.DocTestParser().get_doctest(text, names, where, None, 0)
        assert test.examples or number, f"{where}: no example"
        doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append, clear_globs=False)
        names = test.globs
    assert not said, "".join(said)
