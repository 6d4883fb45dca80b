"""`cr.why`: why objects are known late, whose doing it is, which episodes cost most, how much hangs on the models."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.api.study import AnyExperiment, AnyPath, AnyRecordings, check_any_counted, make_study
from copem_replay.core.errors import ExperimentError, InputError, count_noun
from copem_replay.core.files import atomic_files
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.summary import format_table

if TYPE_CHECKING:
    from copem_replay.pipeline.causes import CauseShares, Counterfactuals

PARTS = ("causes", "units", "triage", "sensitivity")
_SHOWN_GROUPS = 10
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
        """Write the tables as CSV, all or none; those that are there are replaced. Raises OutputError.

        In a results folder they go when its results go.
        """
        from copem_replay.results.folder import add_to_made_list

        place = Path(folder)
        with atomic_files(place, list(self.files)) as scratch:
            for name, table in self.files.items():
                table.to_csv(scratch / name, index=False, lineterminator="\n")
            add_to_made_list(place.parent, [place / name for name in self.files])
        return [place / name for name in self.files]

    def blocks(self, width: int | None = None) -> Iterator[list[str]]:
        """What is said in the terminal, part by part. `width`: None for a pipe."""
        if self.causes is not None:
            for name, of in self.causes.groupby("configuration", sort=False):
                yield _describe_causes(str(name), of, width)
        if self.units is not None:
            for name, of in self.units.groupby("configuration", sort=False):
                yield _describe_units(str(name), of, width)
        if self.triage is not None:
            for name, of in self.triage.groupby("configuration", sort=False):
                yield _describe_groups(str(name), of)
            if not len(self.triage):
                yield ["no object is unknown for more than 1 s in one run of twenty or more"]
        if self.sensitivity is not None and self.orders is not None:
            from copem_replay.pipeline.sensitivity import describe_orders

            yield describe_orders(self.sensitivity, self.orders)


def why(
    experiment: AnyExperiment,
    recordings: AnyRecordings | None = None,
    *,
    configurations: Sequence[str] | None = None,
    parts: Sequence[str] = PARTS,
    units: Sequence[str] | None = None,
) -> Explanation:
    """Explain the time that objects are unknown, `unknown_s`, by replays on the same draws.

    `experiment`, `recordings`: as `cr.run` takes them. `configurations`: only these; None: all that have units.
    `parts`: of `causes`, `units`, `triage`, `sensitivity`. `units`: those whose worth is asked for, the others are
    given; None: all but the ego's.

    Raises InputError: a configuration or unit that is not there, or one that cannot be explained, with the reason.
    Where none is named, such ones are left out, with a note.

    >>> explained = cr.why("logs/tc016d.yaml", configurations=["PEM"], parts=["causes"])
    >>> explained.causes["cause"].tolist()
    ['no unit there', 'hidden', 'missed']
    """
    for part in parts:
        if part not in PARTS:
            raise InputError(f"parts: expected some of {', '.join(PARTS)}, found {part!r}")
    study = make_study(experiment, recordings)
    check_any_counted(study)
    logs = [(one, resolve_for_log(study.experiment, one.scene.log)) for one in study.recordings]
    return _explain(study.experiment, logs, configurations, parts, units)


def _explain(
    experiment: Experiment,
    logs: Sequence[tuple[Recording, Experiment]],
    asked: Sequence[str] | None,
    parts: Sequence[str],
    units: Sequence[str] | None,
) -> Explanation:
    from copem_replay.pipeline.sensitivity import compare_orders, vary_pems

    notes, tables = list[str](), {part: list[pd.DataFrame]() for part in (*PARTS, "late")}
    if 1 < experiment.runs < _FEW_RUNS:
        notes.append(f"{experiment.runs} runs: standard errors are over these; {_FEW_RUNS} make them about 2 %")
    for name in asked or [
        n for n, one in experiment.configurations.items() if one.units != TRUTH and one.recorded is None
    ]:
        for part, table in _explain_configuration(name, logs, parts, units):
            if isinstance(table, pd.DataFrame):
                tables[part].append(table.assign(configuration=name)[["configuration", *table.columns]])
            elif asked is None:
                notes.append(f"{part}: {table}")
            else:
                raise table
    found = {part: pd.concat(of, ignore_index=True) for part, of in tables.items() if of}
    varied = orders = None
    if "sensitivity" in parts:
        try:
            varied = vary_pems(logs)
            orders = compare_orders(varied)
        except ExperimentError as error:
            notes.append(str(error))
    return Explanation(
        found.get("causes"), found.get("units"), found.get("triage"), found.get("late"), varied, orders, tuple(notes)
    )


def _explain_configuration(
    name: str, logs: Sequence[tuple[Recording, Experiment]], parts: Sequence[str], units: Sequence[str] | None
) -> Iterator[tuple[str, pd.DataFrame | ExperimentError]]:
    """The tables of a configuration by part, or why there is none."""
    from copem_replay.pipeline.causes import Counterfactuals, share_lateness, tabulate_causes
    from copem_replay.pipeline.triage import group_late_episodes, list_late_episodes, rank_groups
    from copem_replay.pipeline.worth import compute_unit_worths

    def attempt(part: str, work: Callable[[], pd.DataFrame]) -> Iterator[tuple[str, pd.DataFrame | ExperimentError]]:
        try:
            yield part, work()
        except ExperimentError as error:
            yield part, error

    shares: list[tuple[Counterfactuals, list[CauseShares]]] = []
    if {"causes", "triage"} & set(parts):
        try:
            for recording, experiment in logs:
                replays = Counterfactuals(recording, experiment, name)
                shares.append((replays, share_lateness(replays)))
        except ExperimentError as error:
            yield "causes", error
            return
    if "causes" in parts:
        yield from attempt("causes", lambda: tabulate_causes(shares))
    if "triage" in parts:
        groups, episodes = zip(*(group_late_episodes(replays, of) for replays, of in shares), strict=True)
        yield "triage", rank_groups(pd.concat([of for of in groups if len(of)] or groups[:1], ignore_index=True))
        yield "late", pd.concat([list_late_episodes(of) for of in episodes], ignore_index=True)
    if "units" in parts:
        yield from attempt("units", lambda: compute_unit_worths(logs, name, units).table)


# In words.


def _describe_causes(name: str, causes: pd.DataFrame, width: int | None) -> list[str]:
    from copem_replay.pipeline.triage import describe_cause

    shown = pd.DataFrame({
        "cause": [describe_cause(one) for one in causes["cause"]], "added_s": causes["added_s"].to_numpy(),
        "± s": causes["error_s"].to_numpy(), "gained_s": causes["gained_s"].to_numpy(),
    })  # fmt: skip
    total_s, overlap_s = causes["added_s"].sum(), causes["gained_s"].sum()
    lines = [f"{name}: objects are unknown for {total_s:.2f} s in the mean", *format_table(shown, width).splitlines()]
    if total_s > 0:
        lines.append(
            f"added_s sums to it; gained_s, if only that were gone, does not ({overlap_s / total_s:.2f} of it)"
        )
    return lines


def _describe_units(name: str, units: pd.DataFrame, width: int | None) -> list[str]:
    shown = units.drop(columns="configuration").reset_index(drop=True)
    head = f"{name}: seconds that each unit spares, beside the units that are given"
    return [head, *format_table(shown, width).splitlines()]


def _describe_groups(name: str, groups: pd.DataFrame) -> list[str]:
    from copem_replay.pipeline.triage import describe_cause

    lost_s, lines = groups["lost_s"].sum(), list[str]()
    for row in groups.head(_SHOWN_GROUPS).itertuples():
        where = f" ({row.where})" if row.where else ""
        objects, cause = count_noun(int(row.objects), "object"), describe_cause(str(row.cause))
        lines.append(
            f"{row.log}: {objects}, {row.lost_s:.1f} s, {cause}{where}; "
            f"such as {row.example_class} {row.example} at {row.example_onset_s:.1f} s"
        )
    rest = len(groups) - _SHOWN_GROUPS
    more = [f"and {count_noun(rest, 'group')} more in triage.csv"] if rest > 0 else []
    return [f"{name}: late for more than 1 s, {lost_s:.1f} s in {count_noun(len(groups), 'group')}", *lines, *more]
