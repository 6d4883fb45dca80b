"""What made the results: versions, seed, recordings, how was measured, what has to be said."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from copem_replay.report.html.markup import Html, breakable, folded, joined, listed, table, tag

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study


def provenance(study: Study) -> Html:
    """All of `provenance.json`, as tables."""
    data = study.provenance
    logs = [
        tag("tr", tag("th", str(log["log"]), scope="row"), tag("td", str(log.get("topic") or "–"), class_="text"),
            tag("td", tag("code", str(log["sha256"])), class_="text"))
        for log in data["logs"]
    ]  # fmt: skip
    skipped = [f"{log['log']}: {log['reason']}" for log in data.get("logs_skipped", [])]
    notes = [str(note) for note in data.get("notes", [])]
    if study.regret is not None:
        notes += [note.removeprefix(f"{study.results.folder}: ") for note in study.regret.notes]
    keys = ("copem_replay", "python", "seed", "runs", "window_s", "visibility", "max_gap_s")
    made = {key: data.get(key) for key in keys}
    measured = {key: data.get(key) for key in ("measure", "braking", "run_shown")}
    return joined(
        [
            tag("h3", "Recordings"),
            table(["log", "topic of the truth", "SHA-256"], logs, caption="Recordings that were replayed", id_="logs"),
            tag("p", "Skipped, and not in any figure:" if skipped else "No recording was skipped."),
            listed(skipped),
            tag("h3", "Notes"),
            listed(notes) or tag("p", "There are none."),
            folded("How it was made and measured", _pairs(made | measured, "Parameters", "parameters")),
            folded("Libraries", _pairs(data.get("libraries", {}), "Versions of libraries", "libraries")),
        ]
    )


def _pairs(data: dict[str, Any], caption: str, id_: str) -> Html:
    rows = [
        tag("tr", tag("th", breakable(key), scope="row"), tag("td", value, class_="text"), data_row=key)
        for key, value in _flat(data, "")
    ]
    return table(["key", "value"], rows, caption=caption, id_=id_)


def _flat(data: Any, key: str) -> Iterator[tuple[str, str]]:
    """Each value under its whole key, `measure.onset.kind`."""
    if isinstance(data, dict) and data:
        for name, value in data.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list):
        yield key, ", ".join(map(str, data)) or "–"
    else:
        yield key, _said(data)


def _said(value: Any) -> str:
    if value is None or value == {}:
        return "–"
    if isinstance(value, float):
        return f"{value:.9g}"
    return str(value).lower() if isinstance(value, bool) else str(value)
