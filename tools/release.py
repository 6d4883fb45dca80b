"""A release: wheel and source distribution, checked and tried elsewhere; with `--tag` the changelog and a tag.

    make release                    # builds into dist/, checks, runs the demo from the wheel in a new environment
    make release RELEASE=--tag      # then writes the section of the changelog, commits it, and tags

The version is that of pyproject.toml. Nothing is sent anywhere: docs/develop/release.md says what a maintainer does.
"""

from __future__ import annotations

import argparse
import datetime
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
OPEN = "## Unreleased"


def main(arguments: Sequence[str] | None = None) -> int:
    """Build and try a release; exit code 2 with a line where it cannot be made."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tag", action="store_true", help="write the changelog's section, commit it, and tag")
    asked = parser.parse_args(arguments)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    try:
        changelog = close_section((ROOT / "CHANGELOG.md").read_text("utf-8"), version, datetime.date.today())
        check_tree(version)
        built = build(ROOT / "dist")
        check_content(built)
        try_wheel(next(path for path in built if path.suffix == ".whl"), version)
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 2
    for path in built:
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e6:.1f} MB")
    if asked.tag:
        (ROOT / "CHANGELOG.md").write_text(changelog, "utf-8")
        git("commit", "--quiet", "-m", f"Version {version}", "CHANGELOG.md")
        git("tag", "--annotate", f"v{version}", "-m", f"Version {version}")
        print(f"tagged v{version}; docs/develop/release.md says what comes then")
    return 0


class ReleaseError(Exception):
    """Why no release can be made, as a line."""


def close_section(changelog: str, version: str, date: datetime.date) -> str:
    """The changelog with what is unreleased as the section of a version, under an empty one.

    Raises ReleaseError: nothing is unreleased, or the version has a section.
    """
    if re.search(rf"^## \[?{re.escape(version)}\b", changelog, re.MULTILINE):
        raise ReleaseError(f"CHANGELOG.md: {version} has a section; raise `version` in pyproject.toml")
    found = re.search(rf"^{OPEN}\n(.*?)(?=^## |\Z)", changelog, re.MULTILINE | re.DOTALL)
    if found is None or not found[1].strip():
        raise ReleaseError(f"CHANGELOG.md: expected entries under `{OPEN}`, found none")
    return changelog.replace(f"{OPEN}\n", f"{OPEN}\n\n## {version} - {date.isoformat()}\n", 1)


def check_tree(version: str) -> None:
    """Raise ReleaseError where files are changed, or the version is tagged."""
    if changed := git("status", "--porcelain", "--untracked-files=no"):
        raise ReleaseError(f"expected no changed files, found {changed.splitlines()[0].split()[-1]}")
    if git("tag", "--list", f"v{version}"):
        raise ReleaseError(f"v{version} is tagged; raise `version` in pyproject.toml")


def build(folder: Path) -> list[Path]:
    """The wheel and the source distribution, in a new folder, with metadata that is checked."""
    shutil.rmtree(folder, ignore_errors=True)
    call(sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT))
    built = sorted(folder.iterdir())
    call(sys.executable, "-m", "twine", "check", "--strict", *map(str, built))
    return built


def check_content(built: Sequence[Path]) -> None:
    """Raise ReleaseError where the wheel lacks a file of the package that git has."""
    (wheel,) = (path for path in built if path.suffix == ".whl")
    files = zipfile.ZipFile(wheel).namelist()
    inside = {*files, *(str(Path(name).parent) for name in files)}  # a link to a folder is a folder there
    missing = [name for name in git("ls-files", "copem_replay").splitlines() if name not in inside]
    if missing:
        raise ReleaseError(f"{wheel.name}: {len(missing)} files of the package are not in it, first {missing[0]}")
    (source,) = (path for path in built if path.name.endswith(".tar.gz"))
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    if not {"pyproject.toml", "README.md", "LICENSE"} <= names:
        raise ReleaseError(f"{source.name}: expected pyproject.toml, README.md and LICENSE in it")


def try_wheel(wheel: Path, version: str) -> None:
    """Install the wheel in a new environment elsewhere, and run the demo from it."""
    with tempfile.TemporaryDirectory() as place:
        python = Path(place) / "env" / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        tool = python.with_name("copem-replay")
        call(sys.executable, "-m", "venv", str(python.parents[1]))
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        call(*install, "--require-hashes", "--requirement", str(ROOT / "requirements.txt"))
        call(*install, "--no-deps", str(wheel))
        if (said := call(str(tool), "--version", folder=place).strip()) != f"copem-replay {version}":
            raise ReleaseError(f"{wheel.name}: expected copem-replay {version}, found {said}")
        call(str(tool), "samples", "logs", folder=place)
        print(call(str(tool), "run", "logs/tc016d.yaml", folder=place).splitlines()[-1])


def git(*arguments: str) -> str:
    """What a git command prints."""
    return call("git", *arguments)


def call(*words: str, folder: str | Path = ROOT) -> str:
    """What a command prints. Raises ReleaseError, with its last line, where it fails."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise ReleaseError(f"{' '.join(words[:4])} …: code {done.returncode}: {lines[-1] if lines else 'no words'}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
