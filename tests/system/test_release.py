"""A release: the section of the changelog, and what is refused before anything is built."""

from __future__ import annotations

import datetime
import tomllib
from pathlib import Path

import pytest

from tools import release

ROOT = Path(__file__).parents[2]
DAY = datetime.date(2026, 12, 1)


def test_what_is_unreleased_becomes_the_section_of_the_version() -> None:
    log = "# Changelog\n\n## Unreleased\n\n### Added\n\n- a\n\n## 0.1.0 - 2026-01-01\n\n- b\n"
    assert release.close_section(log, "0.2.0", DAY) == (
        "# Changelog\n\n## Unreleased\n\n## 0.2.0 - 2026-12-01\n\n### Added\n\n- a\n\n## 0.1.0 - 2026-01-01\n\n- b\n"
    )


@pytest.mark.parametrize(
    ("log", "version", "said"),
    [
        (
            "## Unreleased\n\n## 0.1.0 - 2026-01-01\n- b\n",
            "0.2.0",
            "expected entries under `## Unreleased`, found none",
        ),
        ("## 0.1.0 - 2026-01-01\n", "0.2.0", "expected entries under `## Unreleased`, found none"),
        ("## Unreleased\n- a\n## 0.2.0 - 2026-01-01\n", "0.2.0", "0.2.0 has a section; raise `version`"),
    ],
)
def test_no_release_of_nothing_nor_twice(log: str, version: str, said: str) -> None:
    with pytest.raises(release.ReleaseError, match=said):
        release.close_section(log, version, DAY)


def test_the_changelog_at_hand_can_be_released() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    closed = release.close_section(text, version, DAY)
    assert closed.index("## Unreleased") < closed.index(f"## {version} - 2026-12-01")
    assert len(closed) == len(text) + len(f"\n## {version} - 2026-12-01\n")


def test_the_version_stands_in_one_place() -> None:
    """The citation names it, too: nothing reads it from elsewhere."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
