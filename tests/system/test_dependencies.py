"""What is installed beside the project: bounded, and pinned within the bounds."""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


def test_every_dependency_has_both_bounds_and_the_pin_is_within() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}
    for text in project["dependencies"]:
        needed = Requirement(text)
        assert {one.operator for one in needed.specifier} == {">=", "<"}, text
        assert needed.specifier.contains(pins[canonicalize_name(needed.name)]), text
