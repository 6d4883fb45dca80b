"""The site's pages that are no files of docs/: mkdocs calls the functions here while it builds (mkdocs.yml, `hooks`).

Pages link to each other as files of the repository do. Here the links of each page are turned to where a file is in the
site: README, changelog and notebooks are pages, the folder of decisions is a list of them, every other file of the
repository comes along as it is. So the site needs no address of a repository, and a link that leads nowhere stops the
build.
"""

from __future__ import annotations

import base64
import json
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
DECISIONS = "develop/decisions"
ROOT_PAGES = {name: name.lower() for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")}
LINK = re.compile(r"(\]\()([^)\s]+)(\))")
PICTURE = re.compile(r"!\[(.*?)\]\((.*?)\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Headings get the anchors that they have in the repository."""
    config.mdx_configs.setdefault("toc", {})["slugify"] = anchor_of
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the root, notebooks, the list of decisions, the gallery, and what else pages link to."""
    docs = Path(config.docs_dir)
    pages = {file.src_uri: Path(file.abs_src_path) for file in files.documentation_pages() if file.abs_src_path}
    figures: list[tuple[str, str, str]] = []
    made = {place: (ROOT / name).read_text("utf-8") for name, place in ROOT_PAGES.items()}
    sources = [(name, made[place]) for name, place in ROOT_PAGES.items()]
    sources += [(source_of(uri), path.read_text("utf-8")) for uri, path in pages.items()]
    made[f"{DECISIONS}/index.md"] = list_decisions(docs)
    for notebook in sorted(ROOT.glob("notebooks/*.ipynb")):
        page = f"notebooks/{notebook.stem}.md"
        made[page], pictures = notebook_page(notebook)
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
            figures.append((page, f"notebooks/{name}", made[page].splitlines()[0].lstrip("# ")))
    made["gallery.md"] = gallery_page(docs, pages, figures)
    for uri, text in made.items():
        files.append(File.generated(config, uri, content=text))
    for target in sorted(linked_files(sources)):
        files.append(File.generated(config, place_of(target), abs_src_path=str(ROOT / target)))
    for file in files:
        if file.src_uri.startswith(f"{DECISIONS}/") and not file.src_uri.endswith("/index.md"):
            file.inclusion = InclusionLevel.NOT_IN_NAV  # one by one they are in the list of decisions
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn the links of a page from places in the repository to places in the site."""
    uri = page.file.src_uri
    if uri in ("gallery.md", f"{DECISIONS}/index.md"):
        return markdown  # written for the site
    return turn_links(markdown, source_of(uri), uri)


# Where a file of the repository is in the site.


def anchor_of(heading: str, separator: str) -> str:
    """The anchor of a heading, as hosts of repositories write it.

    >>> anchor_of("criteria.<name>: Criterion", "-"), anchor_of("One row of `tally.parquet`", "-")
    ('criterianame-criterion', 'one-row-of-tallyparquet')
    """
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", separator)


def place_of(path: str) -> str:
    """The place in the site of a file or folder of the repository.

    >>> place_of("docs/guide/links.md"), place_of("README.md"), place_of("logs/crossing.yaml")
    ('guide/links.md', 'readme.md', 'files/logs/crossing.yaml')
    >>> place_of("notebooks/01_the_paper.ipynb"), place_of("docs/develop/decisions")
    ('notebooks/01_the_paper.md', 'develop/decisions/index.md')
    """
    if path in ROOT_PAGES:
        return ROOT_PAGES[path]
    if path == f"docs/{DECISIONS}":
        return f"{DECISIONS}/index.md"
    if path.startswith("notebooks/"):
        return path.replace(".ipynb", ".md")
    return path.removeprefix("docs/") if path.startswith("docs/") else f"files/{path}"


def source_of(uri: str) -> str:
    """The file of the repository that a page of the site is made of."""
    for name, place in ROOT_PAGES.items():
        if uri == place:
            return name
    return uri.replace(".md", ".ipynb") if uri.startswith("notebooks/") else f"docs/{uri}"


def turn_links(markdown: str, source: str, uri: str) -> str:
    """A page of the repository with its links as they are in the site. Links elsewhere and within a page stay.

    >>> turn_links("[a](../../README.md#two) [b](links.md) [c](#d)", "docs/guide/seeing.md", "guide/seeing.md")
    '[a](../readme.md#two) [b](links.md) [c](#d)'
    """

    def turned(found: re.Match[str]) -> str:
        target, hash_, anchor = found[2].partition("#")
        if not target or re.match(r"\w+:", target):
            return found[0]
        place = place_of(posixpath.normpath(posixpath.join(posixpath.dirname(source), target)))
        return f"{found[1]}{posixpath.relpath(place, posixpath.dirname(uri) or '.')}{hash_}{anchor}{found[3]}"

    return "".join(part if code else LINK.sub(turned, part) for code, part in split_code(markdown))


def split_code(markdown: str) -> Iterator[tuple[bool, str]]:
    """The parts of a page in turn; whether each is a block of code."""
    for k, part in enumerate(re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)):
        yield bool(k % 2), part


def linked_files(sources: list[tuple[str, str]]) -> set[str]:
    """Files outside docs/ that pages link to and that are no pages of the site."""
    found = set()
    for source, text in sources:
        for code, part in split_code(text):
            for _, target, _ in () if code else LINK.findall(part):
                path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target.partition("#")[0]))
                if place_of(path).startswith("files/") and (ROOT / path).is_file():
                    found.add(path)
    return found


# Pages that are made.


def list_decisions(docs: Path) -> str:
    """A page that lists the decisions by their titles."""
    lines = ["# Decisions", "", "What is decided, and why, room by room.", ""]
    for path in sorted((docs / DECISIONS).glob("*.md")):
        lines.append(f"- [{path.read_text('utf-8').splitlines()[0].lstrip('# ')}]({path.name})")
    return "\n".join([*lines, ""])


def gallery_page(docs: Path, pages: dict[str, Path], figures: list[tuple[str, str, str]]) -> str:
    """A page with every picture of the guide and every figure of the notebooks, each with the page it is from."""
    shown: dict[str, tuple[str, str]] = {}
    sources = {"readme.md": ROOT / "README.md", **pages}
    for uri, path in sources.items():
        for words, target in PICTURE.findall(path.read_text("utf-8")):
            place = place_of(posixpath.normpath(posixpath.join(posixpath.dirname(source_of(uri)), target)))
            shown.setdefault(place, (words, uri))
    lines = ["# Gallery", "", "Each picture leads to the page that explains it.", ""]
    for picture in sorted(shown):
        words, uri = shown[picture]
        lines += [f"[![{words}]({picture})]({uri})", "", f"{words}.", ""]
    lines += ["## From the notebooks", ""]
    for page, picture, title in figures:
        lines += [f"[![A figure of the notebook: {title}]({picture})]({page})", "", f"{title}.", ""]
    return "\n".join(lines)


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as a page: its words, its code, what it printed; and its figures by name."""
    parts, pictures = [], {}
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        for output in cell["outputs"]:
            if png := output.get("data", {}).get("image/png"):
                name = f"{path.stem}_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(png)
                parts.append(f"![A figure that the code above draws]({name})")
            elif text := said(output):
                parts.append(f"```text\n{text}\n```")
    return "\n\n".join([*parts, f"The notebook itself: `{path.relative_to(ROOT).as_posix()}`.", ""]), pictures


def said(output: dict[str, Any]) -> str:
    """The words of an output."""
    return "".join(output.get("text") or output.get("data", {}).get("text/plain", "")).rstrip()
