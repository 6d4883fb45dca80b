"""What is installed beside the project: bounded, and pinned within the bounds."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


def read_pins(file: str) -> dict[str, tuple[str, list[str]]]:
    """Version and hashes by name, of one of the files of pins."""
    text = (ROOT / file).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#") and line != "-r requirements.txt"]
    entries = "\n".join(lines).replace("\\\n", " ").splitlines()
    found = [
        re.fullmatch(r"([\w.-]+)==([^ ;]+)( ; [^-]*?)?((?: +--hash=sha256:[0-9a-f]{64})+)", one) for one in entries
    ]
    assert all(found), "a line that is no pin with hashes, such as an index"
    return {canonicalize_name(one[1]): (one[2], one[4].split()) for one in found if one}


RUNS, REST, RELEASE = (read_pins(f"requirements{of}.txt") for of in ("", "-dev", "-release"))


def test_every_dependency_has_both_bounds_and_the_pin_is_within() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for text in project["dependencies"]:
        needed = Requirement(text)
        assert {one.operator for one in needed.specifier} == {">=", "<"}, text
        assert needed.specifier.contains(RUNS[canonicalize_name(needed.name)][0]), text


def test_every_extra_is_pinned_and_what_is_compiled_has_files_for_many_platforms() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    twice = RUNS.keys() & REST.keys()
    assert twice == {"colorama"}, "pinned twice: only what the site needs on every system, runs on Windows alone"
    assert RUNS["colorama"] == REST["colorama"]
    pins = RUNS | REST
    for name in ("cluster", "dev", "bench"):
        for needed in map(Requirement, project["optional-dependencies"][name]):
            if needed.name != "copem-replay":
                assert needed.specifier.contains(pins[canonicalize_name(needed.name)][0]), str(needed)
    for needed in map(Requirement, project["optional-dependencies"]["release"]):
        assert needed.specifier.contains(RELEASE[canonicalize_name(needed.name)][0]), str(needed)
    assert {name: pin for name, pin in RELEASE.items() if name in pins} == {
        name: pin for name, pin in pins.items() if name in RELEASE
    }, "one version of each package"
    assert all(len(pins[name][1]) > 20 for name in ("numpy", "pandas", "pyarrow", "scipy", "shapely"))


def test_the_page_of_dependencies_says_of_every_package_what_it_is_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    page = (ROOT / "docs/develop/decisions/dependencies.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1:-1] for line in page.splitlines() if re.match(r"\| [\w`]", line)][1:]
    assert all(len(row) == 5 and all(cell.strip() for cell in row) for row in rows)
    runs = " ".join(row[0] for row in rows)
    extras = project["optional-dependencies"]
    used = {Requirement(text).name for text in (*project["dependencies"], *extras["cluster"], *extras["maps"])}
    assert set(re.findall(r"[a-z][\w.-]+", runs)) == used | {"cluster", "maps"}
    rest = {Requirement(text).name for name in ("dev", "bench", "release") for text in extras[name]}
    assert rest - {"copem-replay"} <= set(re.findall(r"[a-z][\w.-]*\w", page.rpartition("|")[2]))
