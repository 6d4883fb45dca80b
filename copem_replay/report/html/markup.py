"""Markup: elements of HTML in which all text but the package's own HTML is escaped; swatches and greys of figures."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from urllib.parse import quote

from copem_replay.core.errors import escape_unprintable
from copem_replay.report.figures.style import Appearance, Colour


class Html(str):
    """Text that is already HTML, and is not escaped."""

    __slots__ = ()


def escape_text(value: str) -> Html:
    """HTML that shows a text literally; Html stays as it is."""
    return value if isinstance(value, Html) else Html(html.escape(escape_unprintable(value)))


def make_tag(name: str, *children: str, **attributes: str | bool | None) -> Html:
    """An element; `class_`, `data_value`: `class`, `data-value`. None or False: without the attribute."""
    text = "".join(
        f" {key.rstrip('_').replace('_', '-')}" + ("" if value is True else f'="{escape_text(value)}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    return Html(f"<{name}{text}>{join_html(children)}</{name}>")


def join_html(parts: Iterable[str], between: str = "") -> Html:
    """Parts in a row, escaped, with `between` between them."""
    return Html(escape_text(between).join(map(escape_text, parts)))


def allow_breaks(name: str) -> Html:
    """A name with possible line breaks after underscores, colons and dots that are no decimal points."""
    return Html(re.sub(r"([_:](?=\w)|\.(?=[a-z]))", r"\1<wbr>", escape_text(name)))


def make_table(head: Sequence[str], rows: Iterable[str], *, caption: str = "", id_: str | None = None) -> Html:
    """A table that scrolls where it is too wide; `head`: names of columns, `rows`: elements."""
    first = make_tag("tr", *(make_tag("th", allow_breaks(name), scope="col") for name in head))
    above = [make_tag("caption", caption)] if caption else []
    table = make_tag("table", *above, make_tag("thead", first), make_tag("tbody", *rows), id_=id_)
    # Without a tab index the keyboard cannot scroll it.
    return make_tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=caption or "table")


# Links between places where one object is shown; a page drops those to what it lacks.


def story_id(log: str, object_id: str) -> str:
    """The id of the element that tells an object's story."""
    return "story-" + quote(f"{log}-{object_id}", safe="").replace("%", "_")


def link_story(log: str, object_id: str, words: str | None = None) -> Html:
    """Words as a link to an object's story; without words it is one of its own. For pages without this story see
    `drop_dead_links`.
    """
    href = f"#{story_id(log, object_id)}"
    return make_tag("a", "story", class_="to", href=href) if words is None else make_tag("a", words, href=href)


def link_player(log: str, object_id: str) -> Html:
    """A link to an object in the player, whose script takes out those to objects that it does not play."""
    return make_tag("a", "player", class_="to", href="#player", data_log=log, data_played=object_id)


_LINK = re.compile(r'( ?)<a( class="to")? href="#([^"]+)"[^>]*>(.*?)</a>')


def drop_dead_links(body: Html) -> Html:
    """A body without links that lead nowhere within it: words of a sentence stay, links of their own go."""
    ids = set(re.findall(r' id="([^"]+)"', body))
    return Html(_LINK.sub(lambda to: to[0] if to[3] in ids else "" if to[2] else to[1] + to[4], body))


def fold_parts(title: str, *parts: str) -> Html:
    """Parts that are unfolded by their title, and on paper."""
    return make_tag("details", make_tag("summary", title), *parts)


def make_list(items: Iterable[str]) -> Html:
    """A list of items; no element without items."""
    elements = [make_tag("li", item) for item in items]
    return make_tag("ul", *elements) if elements else Html()


# Swatches: pieces of lines as in figures (`report/figures/style.py`), for keys and rows of tables.

_PX = 1.25
"""Pixels per point of a line's width: the enlargement of figures on a page."""


def css_colour(colour: Colour) -> str:
    """A colour in CSS, `#rrggbb`."""
    return "#" + bytes(round(255 * channel) for channel in colour).hex()


def _dash_array(look: Appearance, width_px: float) -> str:
    # Dashes are longer on thicker lines, as in the figures, but by less.
    scale = 1.6 * _PX * max(width_px / (1.6 * _PX * 2), 1.0) ** 0.5
    return ",".join(f"{round(length * scale, 1):g}" for length in look.dashes)


def line_swatch(look: Appearance) -> Html:
    """A piece of a configuration's line as SVG."""
    width = look.width_pt * _PX
    dash = _dash_array(look, width) or None

    line = make_tag(
        "line",
        x1="1", y1="7", x2="43", y2="7", stroke=f"var({_variable(look)})", stroke_width=f"{width:.2f}",
        stroke_dasharray=dash,
    )  # fmt: skip
    return make_tag("svg", line, class_="swatch", viewBox="0 0 44 14", aria_hidden="true")


def _variable(look: Appearance) -> str:
    """The variable of the page that is a configuration's colour; its name tells both colours."""
    return f"--c-{css_colour(look.colour)[1:]}-{css_colour(look.dark)[1:]}"


def replace_colours(svg: str, looks: Iterable[Appearance]) -> str:
    """Colours of configurations in styles and attributes as variables; `page_colours` sets them."""
    variables = {css_colour(look.colour): _variable(look) for look in looks}
    return _COLOUR.sub(lambda match: f"var({variables[match[0]]})" if match[0] in variables else match[0], svg)


# Greys of figures become variables of the page, from ink for black to paper for white, so that a dark page inverts
# them.

_COLOUR = re.compile(r"(?<=[: \"])#[0-9a-f]{6}\b")
_OWN = re.compile(r"var\((--c-([0-9a-f]{6})-([0-9a-f]{6}))\)")
_GREY = re.compile(r"(?<=[: \"])#([0-9a-f]{2})\1\1\b")
_USED = re.compile(r"var\(--g-([0-9a-f]{2})\)")
INK, PAPER = (232, 232, 232), (27, 27, 27)
"""Ink and paper of the dark page, equal to those in `page.css`."""


def replace_greys(svg: str) -> str:
    """Greys such as `#262626` as `var(--g-26)`, in styles and attributes; `page.css` sets the rest."""
    return _GREY.sub(r"var(--g-\1)", svg)


def page_colours(html: str) -> str:
    """CSS that sets the variables of a page's greys and configurations, for light paper and dark screens."""
    levels = sorted({int(level, 16) for level in _USED.findall(html)})
    own = sorted(set(_OWN.findall(html)))
    light = [f"--g-{k:02x}:#{k:02x}{k:02x}{k:02x};" for k in levels] + [f"{name}:#{one};" for name, one, _ in own]
    dark = [f"--g-{k:02x}:{_invert_grey(k)};" for k in levels] + [f"{name}:#{other};" for name, _, other in own]
    if not light:
        return ""
    return f":root{{{''.join(light)}}}\n@media screen and (prefers-color-scheme: dark){{:root{{{''.join(dark)}}}}}\n"


def _invert_grey(level: int) -> str:
    """The colour of a grey on the dark page: linear from ink (0) to paper (255)."""
    share = level / 255
    red, green, blue = (round(ink + (paper - ink) * share) for ink, paper in zip(INK, PAPER, strict=True))
    return f"#{red:02x}{green:02x}{blue:02x}"
