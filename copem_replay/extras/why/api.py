"""`cr.why`: why objects are known late, whose doing it is, which episodes cost most, how much hangs on the models."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from copem_replay.api.study import AnyExperiment, AnyPath, AnyRecordings, check_any_counted, make_study
from copem_replay.core.errors import ExperimentError, InputError, count_noun, unknown_name_message
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.summary import format_table
from copem_replay.results.read import Results, open_results

if TYPE_CHECKING:
    from copem_replay.extras.why.causes import CauseShares, Counterfactuals

PARTS = ("causes", "units", "triage", "sensitivity")
_SHOWN_GROUPS = 10
VISIBLE_S = 0.005
"""Seconds that are not 0 when they are rounded to two decimals."""
_FEW_RUNS = 50
"""With fewer runs standard errors of causes are more than about two per cent of the time unknown."""


@dataclass(frozen=True)
class Explanation:
    """Tables of the parts that were asked for; None: not asked for, or nothing it applies to.

    `causes`: seconds of each configuration by cause. `units`: what each of its units is worth. `triage`: its late
    episodes in groups, those that cost most first; `late`: the episodes, each with its causes in words.
    `sensitivity`: time unknown by variation of the PEMs, run by run;
    `orders`: pairs that change order. `notes`: what was left out, and why. Columns: docs/guide/why.md.

    >>> cr.Explanation(notes=("nothing was asked for",)).files
    {}
    """

    causes: pd.DataFrame | None = None
    units: pd.DataFrame | None = None
    triage: pd.DataFrame | None = None
    late: pd.DataFrame | None = None
    sensitivity: pd.DataFrame | None = None
    orders: pd.DataFrame | None = None
    notes: tuple[str, ...] = ()

    @property
    def files(self) -> dict[str, pd.DataFrame]:
        """The tables by the names of their files."""
        tables = {
            "why.csv": self.causes, "units.csv": self.units, "triage.csv": self.triage,
            "late_episodes.csv": self.late, "sensitivity.csv": self.sensitivity,
        }  # fmt: skip
        return {name: table for name, table in tables.items() if table is not None}

    def save(self, folder: AnyPath) -> list[Path]:
        """Write the tables as CSV, all or none; those that are there are replaced. Raises OutputError. In a results
        folder they go when its results go.
        """
        from copem_replay.results.outputs import made_files

        place = Path(folder)
        with made_files(place, list(self.files), place.parent, sealed=True) as scratch:
            for name, table in self.files.items():
                table.to_csv(scratch / name, index=False, lineterminator="\n")
        return [place / name for name in self.files]

    def blocks(self, width: int | None = None) -> Iterator[list[str]]:
        """The text for the terminal, a list of lines for each part. `width`: of the terminal, None for a pipe."""
        if self.causes is not None:
            for name, rows in self.causes.groupby("configuration", sort=False):
                yield _describe_causes(str(name), rows, width)
        if self.units is not None:
            for name, rows in self.units.groupby("configuration", sort=False):
                yield _describe_units(str(name), rows, width)
        if self.triage is not None and self.late is not None:
            for name, rows in self.triage.groupby("configuration", sort=False):
                yield _describe_groups(str(name), rows)
            if not len(self.triage):
                yield ["no object is unknown for more than 1 s in one run of twenty or more"]
            yield from _describe_hopeless(self.late)
        if self.sensitivity is not None and self.orders is not None:
            from copem_replay.extras.why.sensitivity import describe_orders, tabulate_variations

            yield [
                "seconds unknown as PEMs vary",
                *format_table(tabulate_variations(self.sensitivity), width).splitlines(),
            ]
            if len(orders := describe_orders(self.sensitivity, self.orders)):
                yield orders


def why(
    experiment: AnyExperiment | Results,
    recordings: AnyRecordings | None = None,
    *,
    configurations: Sequence[str] | None = None,
    parts: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Explanation:
    """Explain the time that objects are unknown, `unknown_s`, by replays on the same draws.

    `experiment`, `recordings`: as `cr.run` takes them; or results, or their folder, alone: of the logs that were
    replayed. `configurations`: only these; None: all that have units.
    `parts`: of `causes`, `units`, `triage`, `sensitivity`; None: all, where they apply. `units`: those whose worth is
    asked for, the others are given; None: all but the ego's. `progress(done, total)` is called after each
    configuration.

    Raises InputError: a configuration or unit that is not there, or a part that is asked for of a configuration by
    name, which cannot have it, with the reason. What is not named is left out then, with a note. RecordingError
    where a log of results is gone, or not the one that was replayed.

    >>> explained = cr.why("logs/tc016d.yaml", configurations=["PEM"], parts=["causes"])
    >>> explained.causes["cause"].tolist()
    ['no unit there', 'hidden', 'missed']
    """
    for part in parts or ():
        if part not in PARTS:
            raise InputError(f"parts: expected some of {', '.join(PARTS)}, found {part!r}")
    whole, logs = _load_logs(experiment, recordings)
    _check_names(whole, configurations or (), units or ())
    question = _Question(configurations, parts, units)
    return _explain(whole, logs, question, progress or (lambda _done, _total: None))


def _load_logs(
    source: AnyExperiment | Results, recordings: AnyRecordings | None
) -> tuple[Experiment, list[tuple[Recording, Experiment]]]:
    """An experiment, and each recording with its own experiment; of results the recordings that were replayed."""
    if isinstance(source, str | PathLike) and Path(source).is_dir():
        source = open_results(Path(source))
    if isinstance(source, Results):
        if recordings is not None:
            raise InputError(f"{source.place}: expected its own recordings, found others; an experiment takes them")
        log_experiments = [(one.name, resolve_for_log(source.experiment, one.name)) for one in source.provenance.logs]
        return source.experiment, [(source.recording(name, alone), alone) for name, alone in log_experiments]
    study = make_study(source, recordings)
    check_any_counted(study)
    return study.experiment, [(one, resolve_for_log(study.experiment, one.scene.log)) for one in study.recordings]


def _check_names(experiment: Experiment, configurations: Sequence[str], units: Sequence[str]) -> None:
    """Raises ExperimentError for a name that is not there, before anything is replayed."""
    for name in configurations:
        if name not in experiment.configurations:
            raise ExperimentError(unknown_name_message("configuration", name, experiment.configurations))
    for unit in units:
        if unit not in experiment.units:
            raise ExperimentError(unknown_name_message("unit", unit, experiment.units))


@dataclass(frozen=True)
class _Question:
    """What is asked of an experiment; None: all there is."""

    configurations: Sequence[str] | None
    asked_parts: Sequence[str] | None
    units: Sequence[str] | None

    @property
    def parts(self) -> Sequence[str]:
        return self.asked_parts or PARTS

    def select(self, experiment: Experiment) -> list[str]:
        """The configurations that are explained."""
        with_units = [n for n, one in experiment.configurations.items() if one.units != TRUTH and one.recorded is None]
        return list(dict.fromkeys(self.configurations or with_units))

    def note(self, part: str, errors: Sequence[ExperimentError], has_tables: bool) -> Iterator[str]:
        """The reason why a part is left out. Raises it where the part was requested by name."""
        for error in errors:
            if self.configurations is not None and (self.asked_parts is not None or not has_tables):
                raise error
            yield f"no {part}: {error}"


def _explain(
    experiment: Experiment,
    logs: Sequence[tuple[Recording, Experiment]],
    question: _Question,
    progress: Callable[[int, int], None],
) -> Explanation:
    """The tables of the requested parts, and notes. `experiment`: over all logs; some may lack a configuration."""
    notes, tables = list[str](), {part: list[pd.DataFrame]() for part in (*PARTS, "late")}
    rows_of: dict[str, pd.DataFrame] = {}
    latest: dict[int, Counterfactuals] = {}
    names, parts = question.select(experiment), question.parts
    if experiment.runs < _FEW_RUNS:
        run_words = count_noun(experiment.runs, "run")
        notes.append(f"{run_words}: with {_FEW_RUNS} standard errors of causes are about 2 % of the time unknown")
    steps = len(names) + ("sensitivity" in parts)
    for k, name in enumerate(names):
        its_logs = _select_logs(logs, [name])
        if 0 < len(its_logs) < len(logs):
            log_names = ", ".join(recording.scene.log for recording, _ in its_logs.values())
            notes.append(f"{name}: of {log_names} alone; other logs lack its units")
        explained = _explain_configuration(name, its_logs, question, latest)
        for part, table in explained.tables.items():
            tables[part].append(table.assign(configuration=name)[["configuration", *table.columns]])
        for part, error in explained.errors.items():
            notes += question.note(part, [error], bool(explained.tables))
        if explained.rows is not None:
            rows_of[name] = explained.rows
        progress(k + 1, steps)
    joined = {part: pd.concat(of, ignore_index=True) for part, of in tables.items() if of}
    common = list(_select_logs(logs, names).values())
    varied, orders, why_not = _vary(common, names, rows_of) if common and "sensitivity" in parts else (None, None, [])
    notes += question.note("sensitivity", why_not, bool(joined))
    progress(steps, steps)
    if not joined and varied is None:
        raise ExperimentError(notes[-1] if notes else "expected a configuration with units, found none")
    causes, units, triage, late = (joined.get(part) for part in ("causes", "units", "triage", "late"))
    return Explanation(causes, units, triage, late, varied, orders, tuple(dict.fromkeys(notes)))


def _select_logs(
    logs: Sequence[tuple[Recording, Experiment]], names: Sequence[str]
) -> dict[int, tuple[Recording, Experiment]]:
    """By their numbers the logs that have all of these configurations."""
    return {k: log for k, log in enumerate(logs) if {*names} <= log[1].configurations.keys()}


def _vary(
    logs: Sequence[tuple[Recording, Experiment]], names: Sequence[str], known: Mapping[str, pd.DataFrame]
) -> tuple[pd.DataFrame | None, pd.DataFrame | None, list[ExperimentError]]:
    """Time unknown as the PEMs vary, pairs that change order, or why there is none of it."""
    from copem_replay.extras.why.sensitivity import compare_orders, vary_pems

    try:
        varied = vary_pems(logs, names, known)
    except ExperimentError as error:
        return None, None, [error]
    return varied, compare_orders(varied), []


class _PartTables(NamedTuple):
    """The tables of a configuration by part, why there is none of a part, and the rows that causes are of."""

    tables: dict[str, pd.DataFrame]
    errors: dict[str, ExperimentError]
    rows: pd.DataFrame | None = None


def _explain_configuration(
    name: str, logs: Mapping[int, tuple[Recording, Experiment]], question: _Question, latest: dict[int, Counterfactuals]
) -> _PartTables:
    """The tables and errors, by part, of one configuration. `latest`: replays by log, of the configuration before."""
    from copem_replay.extras.why.causes import Counterfactuals, share_lateness, tabulate_causes
    from copem_replay.extras.why.triage import group_late_episodes, list_late_episodes, rank_groups
    from copem_replay.extras.why.worth import compute_unit_worths

    parts, result = question.parts, _PartTables({}, {})
    if {"causes", "triage"} & set(parts):
        shares: list[tuple[Counterfactuals, list[CauseShares]]] = []
        try:
            for k, (recording, experiment) in logs.items():
                latest[k] = replays = Counterfactuals(recording, experiment, name, latest.get(k))
                shares.append((replays, share_lateness(replays)))
        except ExperimentError as error:
            result.errors["causes"] = error
        else:
            result = result._replace(rows=pd.concat([replays.rows for replays, _ in shares], ignore_index=True))
            if "causes" in parts:
                result.tables["causes"] = tabulate_causes(shares)
            if "triage" in parts:
                groups, episodes = zip(*(group_late_episodes(*of_log) for of_log in shares), strict=True)
                late_groups = [of for of in groups if len(of)] or groups[:1]
                result.tables["triage"] = rank_groups(pd.concat(late_groups, ignore_index=True))
                result.tables["late"] = pd.concat([list_late_episodes(of) for of in episodes], ignore_index=True)
    if "units" in parts:
        try:
            result.tables["units"] = compute_unit_worths(list(logs.values()), name, question.units).table
        except ExperimentError as error:
            result.errors["units"] = error
    return result


# In words.


def _describe_causes(name: str, causes: pd.DataFrame, width: int | None) -> list[str]:
    """The table of seconds by cause of one configuration, as lines of text."""
    from copem_replay.extras.why.causes import NO_UNIT, describe_cause

    total_s, overlap_s = causes["added_s"].sum(), causes["gained_s"].sum()
    causes = causes[(causes["cause"] != NO_UNIT) | (causes["added_s"] != 0)]
    shown = pd.DataFrame({
        "cause": [describe_cause(one) for one in causes["cause"]], "added_s": causes["added_s"].to_numpy(),
        "± s": causes["error_s"].to_numpy(), "gained_s": causes["gained_s"].to_numpy(),
    })  # fmt: skip
    lines = [f"{name}: objects are unknown for {total_s:.2f} s in the mean", *format_table(shown, width).splitlines()]
    if total_s > 0:
        lines.append(
            f"added_s: shares, they sum to {total_s:.2f} s; gained_s: what you win by removing this cause alone "
            f"(causes overlap, so these sum to {overlap_s:.2f} s)"
        )
    return [*lines, *_explain_negative(causes)]


def _explain_negative(causes: pd.DataFrame) -> Iterator[str]:
    """Sentences about shares below 0."""
    by_cause = causes.set_index("cause")
    if "fusion" in by_cause.index and by_cause["added_s"]["fusion"] < -VISIBLE_S:
        yield "fusion below 0: entries of a neighbour within the gate are taken for an object that no list has yet"
    worse = [name for name in by_cause.index[by_cause["gained_s"] < -VISIBLE_S] if name != "fusion"]
    if worse and "queue" in by_cause.index:
        yield f"gained_s below 0 ({', '.join(worse)}): without it lists are longer, and wait for the channel"
    elif worse:
        yield f"gained_s below 0 ({', '.join(worse)}): without it the fusion, or other draws, know objects later"


def _describe_units(name: str, units: pd.DataFrame, width: int | None) -> list[str]:
    shown = units.drop(columns="configuration").reset_index(drop=True)
    head = f"{name}: seconds that each unit saves, beside the units that are given"
    return [head, *format_table(shown, width).splitlines()]


def _describe_groups(name: str, groups: pd.DataFrame) -> list[str]:
    """Lines on the groups of late episodes of one configuration that cost most."""
    from copem_replay.extras.why.causes import describe_cause
    from copem_replay.extras.why.triage import TOO_SHORT, describe_structure

    lost_s, lines = groups["lost_s"].sum(), list[str]()
    for row in groups.head(_SHOWN_GROUPS).itertuples():
        where = f" ({row.where})" if row.where else ""
        objects, cause = count_noun(int(row.objects), "object"), describe_cause(str(row.cause))
        how = describe_structure(float(row.structural_share))
        such = f"such as {row.example_class} {row.example} at {row.example_onset_s:.1f} s" if row.example else TOO_SHORT
        lines.append(f"{row.log}: {objects}, {row.lost_s:.1f} s, {cause}{where}{how}; {such}")
    rest, shown = len(groups) - _SHOWN_GROUPS, groups[groups["example"] != ""]
    more = [f"and {count_noun(rest, 'group')} more in triage.csv"] if rest > 0 else []
    more += [
        f"look at one in results: copem-replay view FOLDER --object {first.example} --log {first.log}"
        for first in shown.head(1).itertuples()
    ]
    head = f"{name}: late for more than 1 s, {lost_s:.1f} s in {count_noun(len(groups), 'group')}"
    return [head, *lines, *more]


def _describe_hopeless(late: pd.DataFrame) -> Iterator[list[str]]:
    """How many episodes nobody can know in time, which are in no group."""
    hopeless = late[late["hopeless_share"] >= 1]
    for name, of in hopeless.groupby("configuration", sort=False):
        what, lost_s = count_noun(len(of), "episode"), of["unknown_s"].sum()
        yield [f"{name}: {what}, {lost_s:.1f} s, end before any list can tell of them: in no group"]
