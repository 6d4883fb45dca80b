"""What a fit writes: its page `fit.html`, the folder with PEM, experiment and rows, and places for the viewer."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from copem_replay.core.colours import Rgb
from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.core.yaml import dump_with_comments, dump_yaml
from copem_replay.experiment.schema import Experiment
from copem_replay.extras.fitting.diagnostics import FIT_FIGURES
from copem_replay.extras.fitting.estimate import Rung
from copem_replay.extras.fitting.fit import (
    Fit,
    build_experiment,
    build_snippet,
    judge_use,
    name_estimates,
    to_plain_data,
)
from copem_replay.extras.fitting.gather import Gathered
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.io.recording import Recording
from copem_replay.pipeline.status import to_nanoseconds
from copem_replay.pipeline.study_log import compute_log_digests
from copem_replay.report.figures.style import format_three_digits
from copem_replay.report.html.markup import Html, allow_breaks, join_html, make_list, make_table, make_tag
from copem_replay.report.html.page import figure_element, section_links, whole_page
from copem_replay.results.folder import EXPERIMENT, MARK, ResultsPlace
from copem_replay.results.provenance import list_versions, log_entries
from copem_replay.results.table_files import write_parquet
from copem_replay.viewer.sink import (
    ELAPSED,
    GROUND,
    RecordingSink,
    digest_texts,
    file_stream,
    plain_part,
    stack_float32,
)

if TYPE_CHECKING:
    from rerun import blueprint as rrb

# The page: the numbers, the choices, what is not determined, and the figures with plain words.


def fit_page(fit: Fit) -> str:
    """The whole page as HTML, which loads nothing from elsewhere."""
    sections = [
        *_figure_sections(fit),
        ("estimates", "What was estimated", _estimates_table(fit)),
        ("choices", "Which models were compared", _choice_tables(fit)),
        ("untold", "What cannot be told", make_list(_list_untold(fit)) or make_tag("p", "Nothing is left open.")),
    ]
    rows = fit.gathered.rows
    lead = (
        f"{count_noun(len(fit.gathered.lists.log), 'list')} in {count_noun(len(fit.logs), 'log')}, "
        f"{count_noun(len(rows.log), 'row')} (a list and a true object within reach), of which "
        f"{int(rows.listed.sum())} are listed, in {count_noun(fit.gathered.number_of_passes, 'pass', 'passes')}."
    )
    head = make_tag(
        "header",
        make_tag("h1", f"The perception of {fit.unit}"),
        make_tag("p", judge_use(fit), class_="question"),
        make_tag("p", lead, class_="lead"),
        *([make_tag("p", f"{fit.needless}.")] if fit.needless else []),
        make_list(fit.said),
        section_links((id_, title) for id_, title, _ in sections),
    )
    below = (make_tag("section", make_tag("h2", title), body, id_=id_) for id_, title, body in sections)
    return whole_page(f"Fit of {fit.unit}", join_html([head, *below]))


def _figure_sections(fit: Fit) -> Iterator[tuple[str, str, Html]]:
    for name, kind in FIT_FIGURES.items():
        why = kind.missing(fit)
        if why is None:
            body = join_html([figure_element(name, kind.draw(fit), kind.title, kind.shows), make_tag("p", kind.about)])
        else:
            body = make_tag("p", f"No figure: {why}.")
        yield f"section-{name}", kind.title, body


def _estimates_table(fit: Fit) -> Html:
    """The table of all fitted numbers with their intervals and how many rows they are from."""
    rows = [
        make_tag(
            "tr",
            make_tag("th", allow_breaks(describe_name(fit, name)), scope="row"),
            *(make_tag("td", "–" if "nan" in shown else shown.replace("-", "−")) for shown in estimate.shown()),
            make_tag("td", str(estimate.n) if estimate.n else "–"),
            make_tag("td", format_three_digits(estimate.n_effective) if estimate.n_effective > 0 else "–"),
            make_tag("td", estimate.why or ("chosen" if estimate.chosen else ""), class_="text"),
        )
        for name, estimate in list_estimates(fit)
    ]
    head = ("number", "estimate", "95 %", "n", "effective n", "not identifiable")
    return make_table(head, rows, caption="Every number with its interval", id_="numbers")


def _list_ladders(fit: Fit) -> dict[str, Sequence[Rung]]:
    """The compared models, by the quantity they describe."""
    errors = fit.parts.errors
    return {"detection": fit.parts.detection.ladder, "errors": errors.ladder, "frame of errors": errors.frames}


def _choice_tables(fit: Fit) -> Html:
    """Tables of the models that were compared, a table by quantity, with scores and the chosen one."""
    intro = (
        "Each model is scored on passes it was not fitted to; the simplest within one standard error of the best is "
        "written. Where too few passes are there to hold any out, BIC decides."
    )
    parts: list[Html] = [make_tag("p", intro)]
    for title, rungs in _list_ladders(fit).items():
        rows = [
            make_tag(
                "tr",
                make_tag("th", rung.name, scope="row"),
                make_tag("td", format_three_digits(rung.score)),
                make_tag("td", f"{rung.below:.3g} ± {rung.below_se:.2g}" if rung.below else "–"),
                make_tag("td", rung.by, class_="text"),
                make_tag("td", "chosen" if rung.chosen else "", class_="text"),
            )
            for rung in rungs
        ]
        head = ("model", "nats per list", "below the best", "scored by", "")
        parts.append(make_table(head, rows, caption=title.capitalize()))
    return join_html(parts)


def _list_untold(fit: Fit) -> list[str]:
    reasons = {**fit.parts.errors.untold, **fit.parts.rest.untold}
    if fit.parts.detection.memory_why is not None:
        reasons = {"memory.detection": fit.parts.detection.memory_why, **reasons}
    return [f"{name}: {why}" for name, why in reasons.items()]


# Names in words.

_WORDS = {
    "delay_s": "delay of the lists, s",
    "rate_hz": "lists per second",
    "ids_last_s": "track ids last, s",
    "list_times.period_s": "time between lists, s",
    "list_times.jitter_s": "its standard deviation, s",
    "list_times.down_share": "outages: share of the time",
    "list_times.lasts_s": "outages last, s",
    "errors.yaw_sigma_deg": "error of yaw: standard deviation, °",
    "errors.speed_sigma_mps": "error of speed: standard deviation, m/s",
    "errors.size_sigma_m": "error of size: standard deviation, m",
    "errors.shape.degrees_of_freedom": "errors: degrees of freedom of Student's t (many: Gaussian)",
    "placed.position_sigma_m": "pose of the unit: standard deviation, m",
    "placed.yaw_sigma_deg": "pose of the unit: standard deviation of the heading, °",
    "ghosts.per_minute": "ghosts that begin in a minute",
}
_LASTING = {"share": "share that lasts", "correlation_s": "correlation time, s"}


def describe_name(fit: Fit, name: str) -> str:
    """The name of an estimate in words: `errors.bins.0.mean_m.0` is `error, 0 to 30 m: mean along, m`."""
    words, errors = name.split("."), fit.parts.errors
    axes = errors.axes
    if name.startswith("errors.bins."):
        kinds = {
            "mean_m": [f"mean {axis}, m" for axis in axes],
            "covariance_m2": [f"variance {axes[0]}, m²", "covariance, m²", f"variance {axes[1]}, m²"],
        }
        return f"error, {errors.bins[int(words[2])].where.words}: {kinds[words[3]][int(words[4])]}"
    if name.startswith("detection.couples."):
        couple = fit.parts.detection.couples[int(words[2])]
        return f"detected, {couple.place_words(int(words[4]), int(words[5]))}"
    if name.startswith("errors.between_logs."):
        return f"error: standard deviation between logs {axes[int(words[3])]}, m"
    if words[-1] in _LASTING and "memory" in words:
        of = "detection" if words[0] == "detection" else "class" if words[0] == "classes" else words[2]
        of = "pose of the unit" if words[0] == "placed" else of
        number = f", part {int(words[-2]) + 1}" if words[-2].isdigit() else ""
        return f"memory of {of}{number}: {_LASTING[words[-1]]}"
    if name.startswith("delay_s."):
        return f"delay of entries about a {words[1]}, s"
    if name.startswith("classes.confusion."):
        return f"{words[2]} listed as {words[3]}"
    return _WORDS.get(name, " ".join(words).replace("_", " "))


# The folder: the PEM to paste, the experiment that replays it beside the recording, rows and estimates. It is complete
# under its name or missing, as a results folder (`results/folder.py`).

PEM, ROWS, ESTIMATES, PAGE, PLACES = "pem.yaml", "rows.parquet", "fit.json", "fit.html", "places.rrd"


def fill_fit(place: ResultsPlace, fit: Fit, experiment: Experiment, recordings: Sequence[Recording]) -> None:
    """Write a fit into a folder that is reserved. Raises OutputError.

    The page and the places are left out where they cannot be written (`place.left_out`).
    """
    files = sorted([PEM, EXPERIMENT, ROWS, ESTIMATES, MARK, PAGE, PLACES])
    replayed = [one for one in recordings if one.scene.log in (fit.held_out or fit.logs)]
    provenance = list_versions() | {
        "format": "fit",
        "unit": fit.unit,
        "logs": [{"log": r.scene.log, "topic": r.topic, **compute_log_digests(r)} for r in recordings],
        "notes": list(fit.said),
    }
    try:
        place.scratch.may_remove(files)
        new = place.new
        (new / PEM).write_text(pem_text(fit, experiment), encoding="utf-8")
        names = {recording.scene.log for recording in replayed}
        settings = [entry for entry in experiment.logs if isinstance(entry, str) or entry.name in names]
        data = build_experiment(fit, experiment, log_entries(settings, replayed, place.folder))
        (new / EXPERIMENT).write_text(dump_yaml(data), encoding="utf-8")
        write_parquet(rows_table(fit, recordings), new / ROWS)
        (new / ESTIMATES).write_text(
            _format_json(describe_estimates(fit) | {"provenance": provenance}), encoding="utf-8"
        )
        with place.may_fail([PAGE]):
            (new / PAGE).write_text(fit_page(fit), encoding="utf-8")
        with place.may_fail([PLACES]):
            write_fit_places(new / PLACES, fit.unit, fit.logs, fit.gathered.rows, fit.gathered.lists)
        files = [name for name in files if name not in place.left_out]
        (new / MARK).write_text(_format_json(provenance | {"files": files}), encoding="utf-8")
        place.finish(files)
    except OSError as error:
        raise place.cannot_be_written(error) from error


def _format_json(data: Mapping[str, Any]) -> str:
    return json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def pem_text(fit: Fit, experiment: Experiment) -> str:
    """`pem.yaml`: a head on the whole fit, and the interval of every number as a comment."""
    rest, between, shape = fit.parts.rest, fit.parts.errors.between_logs, fit.parts.errors.shape
    head = [
        judge_use(fit),
        f"Unit {fit.unit}, fitted to {count_noun(len(fit.logs), 'log')}: {', '.join(fit.logs)}",
        *([f"Held out: {', '.join(fit.held_out)}"] if fit.held_out else []),
        f"{fit.gathered.matched} entries of true objects in {len(fit.gathered.lists.log)} lists, "
        f"{count_noun(fit.gathered.number_of_passes, 'pass', 'passes')}; truth {fit.truth}",
        f"delay of its lists: `latency_s: {{{fit.unit}: {fit.delay.seconds:.3g}}}` in a configuration: "
        f"{fit.delay.estimate.words()}",
        *(f"delay of entries about a {kind}: {one.words()}" for kind, one in fit.delay.of_class.items()),
        *(["delays by class are not replayed: a replay has one latency for a list"] if fit.delay.of_class else []),
        *(f"{name}: not fitted: {why}" for name, why in rest.untold.items()),
        *([f"errors: {shape.words()}"] if shape.heavier else []),
        *([f"between_logs: not written: {between.untold}"] if between is not None and between.untold else []),
        *fit.gates,
    ]
    return "".join(f"# {' '.join(line.split())}\n" for line in head) + dump_with_comments(
        build_snippet(fit, experiment)
    )


def describe_estimates(fit: Fit) -> dict[str, Any]:
    """`fit.json`: every estimate, and the data behind it."""
    return {
        "unit": fit.unit,
        "logs": list(fit.logs),
        "held_out": list(fit.held_out),
        "how": to_plain_data(fit.how),
        "truth": fit.truth,
        "reach": to_plain_data(fit.gathered.reach),
        "lists": len(fit.gathered.lists.log),
        "rows": len(fit.gathered.rows.list),
        "matched": fit.gathered.matched,
        "passes": fit.gathered.number_of_passes,
        "beyond_gate_share": fit.gathered.beyond,
        "other_gates": list(fit.gates),
        "estimates": {name: to_plain_data(one) for name, one in list_estimates(fit)},
        "parts": to_plain_data(fit.parts),
        "replay_check": to_plain_data(fit.checks),
        "needless": fit.needless,
        "notes": list(fit.said),
    }


def list_estimates(fit: Fit) -> list[tuple[str, Any]]:
    """Every estimate by its name."""
    first = [("delay_s", fit.delay.estimate), *((f"delay_s.{kind}", one) for kind, one in fit.delay.of_class.items())]
    first.append(("rate_hz", fit.rate_hz))
    return first + [(name.removeprefix("rest."), one) for name, one in name_estimates(fit.parts)]


def rows_table(fit: Fit, recordings: Sequence[Recording]) -> pd.DataFrame:
    """`rows.parquet`: a row per list and true object within reach."""
    pieces = [_build_rows(fit.gathered, fit.logs, recordings).assign(held_out=False)]
    if fit.held is not None:
        pieces.append(_build_rows(fit.held, fit.held_out, recordings).assign(held_out=True))
    return pd.concat(pieces, ignore_index=True)


def _build_rows(gathered: Gathered, logs: Sequence[str], recordings: Sequence[Recording]) -> pd.DataFrame:
    """The rows that a model is fitted to, as a table: a row by list and true object, with its errors if listed."""
    rows, view = gathered.rows, gathered.rows.view
    scenes = {recording.scene.log: recording.scene for recording in recordings}
    names = [scenes[logs[k]].object_ids[o] for k, o in zip(rows.log.tolist(), rows.object.tolist(), strict=True)]
    columns: dict[str, Any] = {
        "log": np.array(logs, dtype=object)[rows.log],
        "list": rows.list,
        "object_id": names,
        "object_class": np.array(CLASSES, dtype=object)[view.class_ix],
        "pass": rows.pass_ix,
        "fold": rows.fold,
        "captured_s": rows.captured_s,
        **{name: getattr(view, name) for name in ("range_m", "azimuth_rad", "bearing_rad", "visible_share")},
        "speed_mps": view.speed_mps,
        "true_x_m": rows.state_m[:, 0],
        "true_y_m": rows.state_m[:, 1],
        "listed": rows.listed,
        **{f"error_{name}": getattr(rows, name) for name in ("along_m", "across_m", "east_m", "north_m", "yaw_rad")},
        "error_speed_mps": rows.speed_mps,
        **{f"error_{name}_m": rows.size_m[k] for k, name in enumerate(("length", "width", "height"))},
        "listed_class": [CLASSES[k] if k >= 0 else None for k in rows.class_ix.tolist()],
        "existence": rows.existence,
        "track_id": pd.array(rows.track_id, dtype="Int64"),
    }
    columns["track_id"][rows.track_id < 0] = pd.NA
    return pd.DataFrame(columns)


def table_lines(fit: Fit) -> list[str]:
    """The estimates as lines of a table, what is not fitted, and which models were compared."""
    lines = [judge_use(fit), *(f"{describe_name(fit, name)}: {one.words()}" for name, one in list_estimates(fit))]
    lines += [f"not fitted: {line}" for line in _list_untold(fit)]
    lines += [f"{what}, {rung.words()}" for what, rungs in _list_ladders(fit).items() for rung in rungs]
    lines += [] if fit.checks is None else list(fit.checks.lines())
    return lines + ([fit.needless] if fit.needless else [])


# Places for the viewer: errors and misses of a fitted unit, all at once and list by list.

LISTED: Rgb = (86, 180, 233)
MISSED: Rgb = (255, 90, 90)
ERROR: Rgb = (230, 159, 0)
UNIT: Rgb = (255, 255, 255)


def write_fit_places(path: Path, unit: str, logs: tuple[str, ...], rows: FitRows, lists: FitLists) -> None:
    """Write where true objects are listed, with an arrow to the entry, and where they are missed, in each log.

    Times are since the start of each log; heights are left out. Raises OutputError.
    """
    ids = "copem_replay_fit", digest_texts(unit, *logs, str(len(rows.log)))
    with file_stream(path, *ids) as rec:
        rec.send_blueprint(_fit_blueprint(logs, rows))
        out = RecordingSink(rec, 0)
        for log, name in enumerate(logs):
            mine = np.flatnonzero(rows.log == log)
            in_order = rows.take(mine[np.argsort(rows.list[mine], kind="stable")])
            _send_log(out, plain_part(name), unit, in_order, lists, np.flatnonzero(lists.log == log))


def _send_log(out: RecordingSink, log: str, unit: str, rows: FitRows, lists: FitLists, ix: Int) -> None:
    """Send one log to the viewer: listed and missed objects, errors as arrows, and the unit. `ix`: its lists."""
    import rerun as rr

    elapsed_ns = to_nanoseconds(lists.captured_s[ix])

    def send(layer: str, columns: Any, list_ix: Int, look: Any) -> None:
        count = np.bincount(list_ix - ix[0], minlength=len(ix)) if len(ix) else np.zeros(0, dtype=np.int64)
        out.columns(["world", log, layer], elapsed_ns, columns.partition(count))
        out.static(["world", log, layer], look)

    for layer, shown, colour, size in (("listed", rows.listed, LISTED, 3), ("missed", ~rows.listed, MISSED, 4)):
        points = rr.Points3D.columns(positions=_flat_positions(*rows.state_m[shown].T))
        look = rr.Points3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(size))
        send(layer, points, rows.list[shown], look)
    erring = rows.take(rows.listed & np.isfinite(rows.east_m))
    origins, vectors = _flat_positions(*erring.state_m.T), _flat_positions(erring.east_m, erring.north_m)
    arrows = rr.Arrows3D.columns(origins=origins, vectors=vectors)
    send("error", arrows, erring.list, rr.Arrows3D.from_fields(colors=[ERROR], radii=rr.Radius.ui_points(1)))
    places = rr.Points3D.columns(positions=_flat_positions(lists.east_m[ix], lists.north_m[ix]))
    mark = rr.Points3D.from_fields(colors=[UNIT], radii=rr.Radius.ui_points(7), labels=[unit], show_labels=True)
    send("unit", places, ix, mark)


def _flat_positions(east_m: Float, north_m: Float) -> np.ndarray:
    return stack_float32(east_m, north_m, np.zeros(len(east_m)))


def _fit_blueprint(logs: tuple[str, ...], rows: FitRows) -> rrb.Blueprint:
    """The layout of the viewer: two views from above, one of whole logs and one of the current list."""
    import rerun.blueprint as rrb

    low, high = rows.state_m.min(axis=0), rows.state_m.max(axis=0)
    middle = np.append((low + high) / 2, 0.0)
    away_m = 1.8 * max(float((high - low).max()), 20.0)
    eye = rrb.EyeControls3D(
        position=(middle + np.array([0.0, -0.01, 1.0]) * away_m).tolist(), look_target=middle.tolist(), eye_up=(0, 1, 0)
    )
    every = rrb.VisibleTimeRange(ELAPSED, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
    views = [
        rrb.Spatial3DView(origin="world", name=name, eye_controls=eye, time_ranges=ranges, background=GROUND)
        for name, ranges in (("All errors and misses", [every]), ("At this time", []))
    ]
    panel = rrb.TimePanel(timeline=ELAPSED, state="collapsed")
    return rrb.Blueprint(
        rrb.Horizontal(*views), panel, rrb.SelectionPanel(state="collapsed"), auto_layout=False, auto_views=False
    )
