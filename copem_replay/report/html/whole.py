"""A page as a file: one that loads nothing."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files

from copem_replay.report.html.greys import dark_greys
from copem_replay.report.html.markup import Html, listed, tag, text

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
"""What a browser lets the page load: nothing."""


def contents(sections: Iterable[tuple[str, str]]) -> Html:
    """Links to sections, (id, title) each."""
    links = [tag("a", title, href=f"#{id_}") for id_, title in sections]
    return tag("nav", listed(links), aria_label="Contents", class_="screen")


def whole_page(title: str, body: Html) -> str:
    """All of the page around a body: its style, its script, and what a dark screen makes of greys."""
    own = files("copem_replay.report.html")
    style, script = ((own / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="color-scheme" content="light dark">',
            '<link rel="icon" href="data:,">',
            f"<title>{text(title)}</title>\n<style>\n{style}{dark_greys(body)}</style>\n</head>\n<body>\n<main>",
            body,
            f"</main>\n<script>\n{script}</script>\n</body>\n</html>\n",
        ]
    )
