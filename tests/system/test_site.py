"""The site: all pages are in it, links and anchors lead somewhere or stop the build, and nothing is fetched."""

from __future__ import annotations

import doctest
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import site_pages  # noqa: E402


def build(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", *map(str, words)],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site. The build is strict: a page outside the navigation, a dead link or anchor fails it."""
    folder = tmp_path_factory.mktemp("site")
    done = build("--site-dir", folder)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


def test_every_page_of_the_docs_is_in_the_site(site: Path) -> None:
    made = {path.relative_to(site).with_suffix(".md").as_posix() for path in site.rglob("*.html")}
    assert {path.relative_to(ROOT / "docs").as_posix() for path in ROOT.glob("docs/**/*.md")} <= made
    assert {"readme.md", "changelog.md", "gallery.md", "develop/decisions/index.md"} <= made
    assert {f"notebooks/{path.stem}.md" for path in ROOT.glob("notebooks/*.ipynb")} <= made


def test_pages_fetch_nothing_from_elsewhere(site: Path) -> None:
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        fetched = re.findall(r"<(?!a\b)\w+[^>]*\s(?:src|href|data|action)=[\"']?(?:https?:)?//[^\"' >]+", text)
        assert fetched == [], path.name
        assert 'class="mermaid"' not in text, "the theme fetches a script for these"
    for path in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(?:https?:)?//|@import", path.read_text(encoding="utf-8")), path.name


def test_the_search_finds_keys_names_and_words(site: Path) -> None:
    found = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))["docs"]
    titles = {re.sub(r"<.*?>", "", entry["title"]) for entry in found}
    assert {"cr.load_experiment", "The same bytes", "pems.&lt;name&gt;[].when: Condition"} <= titles
    assert any("penetration_rate" in entry["text"] for entry in found)


def test_the_gallery_shows_every_picture_and_every_figure_of_a_notebook(site: Path) -> None:
    shown = set(re.findall(r'<img[^>]* src="([^"]*)"', (site / "gallery.html").read_text(encoding="utf-8")))
    assert {f"pictures/{path.name}" for path in ROOT.glob("docs/pictures/*.png")} <= shown
    figures = 0
    for path in ROOT.glob("notebooks/*.ipynb"):
        figures += sum(
            "image/png" in output.get("data", {})
            for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]
            for output in cell.get("outputs", [])
        )
    assert sum(name.startswith("notebooks/") for name in shown) == figures > 0
    for name in shown:
        assert (site / name).read_bytes().startswith(b"\x89PNG")


def test_a_link_an_anchor_or_a_page_that_leads_nowhere_stops_the_build(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/index.md").write_text("# One\n\n[here](#one) [a](#two) [b](gone.md) [c](index.md#three)\n")
    (tmp_path / "docs/left.md").write_text("# In no list\n")
    (tmp_path / "mkdocs.yml").write_text(f"INHERIT: {ROOT}/mkdocs.yml\nhooks: []\nnav: [index.md]\n")
    done = build("--config-file", tmp_path / "mkdocs.yml", "--site-dir", tmp_path / "site")
    assert done.returncode == 1
    (left, *links) = re.findall(r"WARNING +- (.*(?:\n  - .*)?)", done.stderr)
    assert "left.md" in left
    assert [re.findall(r"'(#two|gone\.md|index\.md#three|#one)'", line)[:1] for line in sorted(links)] == [
        ["#two"], ["gone.md"], ["index.md#three"]
    ]  # fmt: skip


def test_links_are_turned_to_the_places_of_the_site() -> None:
    assert doctest.testmod(site_pages).failed == 0
    page = "[n](../../notebooks/01_the_paper.ipynb) [d](../develop/decisions)\n```\n[x](../../README.md)\n```\n"
    assert site_pages.turn_links(page, "docs/guide/links.md", "guide/links.md") == (
        "[n](../notebooks/01_the_paper.md) [d](../develop/decisions/index.md)\n```\n[x](../../README.md)\n```\n"
    )


def test_other_files_of_the_repository_come_along() -> None:
    text = (
        "[yaml](../../logs/tc016d.yaml) [gone](../../logs/gone.yaml) [page](../index.md) [web](https://example.org/a)"
    )
    assert site_pages.linked_files([("docs/guide/links.md", text)]) == {"logs/tc016d.yaml"}
    assert site_pages.place_of("logs/tc016d.yaml") == "files/logs/tc016d.yaml"
