"""The page of a fit, `fit.html`: the numbers, the choices, what is untold, and the figures with plain words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from copem_replay.core.text import counted
from copem_replay.pipeline.fit.choice import Rung
from copem_replay.pipeline.fit.estimate import Estimate
from copem_replay.report.figures.captions import plain
from copem_replay.report.fit.registry import FIT_FIGURES
from copem_replay.report.fit.study import FitStudy
from copem_replay.report.html.embedded import drawn
from copem_replay.report.html.markup import Html, breakable, joined, listed, table, tag
from copem_replay.report.html.whole import contents, whole_page


def fit_page(study: FitStudy) -> str:
    """The whole page as HTML, nothing of which has to be fetched."""
    sections = [
        ("estimates", "What was estimated", _estimates(study)),
        ("choices", "Which models were compared", _choices(study)),
        ("untold", "What cannot be told", listed(_untold(study)) or tag("p", "Nothing is left open.")),
        *_figures(study),
    ]
    rows, first = study.rows, study.first_rows
    said = (
        f"{counted(len(study.lists.log), 'list')} in {counted(len(study.logs), 'log')}, "
        f"{counted(len(rows.log), 'row')} (a list and a true object within reach), of which "
        f"{int(rows.listed.sum())} are listed, in {counted(len(first) - 1, 'pass', 'passes')}."
    )
    head = tag(
        "header",
        tag("h1", f"The perception of {study.unit}"),
        tag("p", "A perception error model that was fitted to recorded lists.", class_="question"),
        tag("p", said, class_="lead"),
        listed(study.notes),
        contents((id_, title) for id_, title, _ in sections),
    )
    below = (tag("section", tag("h2", title), body, id_=id_) for id_, title, body in sections)
    return whole_page(f"Fit of {study.unit}", joined([head, *below]))


def _figures(study: FitStudy) -> Iterator[tuple[str, str, Html]]:
    for name, kind in FIT_FIGURES.items():
        why = kind.missing(study)
        if why is None:
            body = joined([drawn(name, kind.draw(study), kind.title, kind.shows), tag("p", kind.about)])
        else:
            body = tag("p", f"No figure: {why}.")
        yield f"section-{name}", kind.title, body


def _estimates(study: FitStudy) -> Html:
    rows = [
        tag("tr", tag("th", breakable(name), scope="row"), tag("td", _value(one)), tag("td", _interval(one)),
            tag("td", str(one.n) if one.n else "–"), tag("td", plain(one.n_effective) if one.n_effective > 0 else "–"),
            tag("td", one.why or ("chosen" if one.chosen else ""), class_="text"))
        for name, one in study.estimates.items()
    ]  # fmt: skip
    head = ("number", "estimate", "95 %", "n", "effective n", "not identifiable")
    return table(head, rows, caption="Every number with its interval", id_="numbers")


def _value(one: Estimate) -> str:
    return "–" if np.isnan(one.value) else plain(one.value)


def _interval(one: Estimate) -> str:
    if np.isnan(one.low) and np.isnan(one.high):
        return "–"
    return f"{plain(one.low)} … {'∞' if np.isinf(one.high) else plain(one.high)}"


def _choices(study: FitStudy) -> Html:
    ladders: Sequence[tuple[str, Sequence[Rung]]] = (
        ("Detection", study.detection.ladder),
        ("Position error", study.errors.ladder),
        ("Frame of the position error", study.errors.frames),
    )
    parts: list[Html] = [
        tag("p", "Each model is scored on passes it was not fitted to; the simplest within one standard error of the "
            "best is written. Where too few passes are there to hold any out, BIC decides.")
    ]  # fmt: skip
    for title, rungs in ladders:
        rows = [
            tag("tr", tag("th", rung.name, scope="row"), tag("td", plain(rung.score)),
                tag("td", "–" if rung.below == 0 else f"{plain(rung.below)} ± {plain(rung.below_se)}"),
                tag("td", rung.by, class_="text"), tag("td", "chosen" if rung.chosen else "", class_="text"))
            for rung in rungs
        ]  # fmt: skip
        parts.append(table(("model", "nats per list", "below the best", "scored by", ""), rows, caption=title))
    return joined(parts)


def _untold(study: FitStudy) -> list[str]:
    said = {**study.errors.untold, **study.rest.untold}
    if study.detection.memory_why is not None:
        said = {"memory.detection": study.detection.memory_why, **said}
    return [f"{name}: {why}" for name, why in said.items()]
