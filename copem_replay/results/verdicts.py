"""Judgement: whether criteria are met, as text, JSON lines, JUnit XML and Markdown, and read back from JSON lines.

*Met*: the whole interval is on the good side of the bound; *not met*: all of it is on the other; *undecided*: the bound
is in it; *not measured*: there is no row, or no interval. Files have no clock and no host: equal results, equal bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd

from copem_replay.core.errors import InputError, count_noun, escape_unprintable
from copem_replay.core.files import parse_json
from copem_replay.metrics.limits import format_limits
from copem_replay.metrics.summary import format_cell, format_table
from copem_replay.metrics.summary_metrics import COMPARED, METRIC
from copem_replay.results.compare.tables import escape_markdown
from copem_replay.results.outputs import check_output, check_outputs, made_file
from copem_replay.results.table_files import AGAIN

MET, NOT_MET, UNDECIDED, NOT_MEASURED = "met", "not met", "undecided", "not measured"
WORDS = (MET, NOT_MET, UNDECIDED, NOT_MEASURED)
FILE = "verdicts.jsonl"
"""The file of verdicts in a results folder."""
_SAME = 1e-9
"""A limit this close to the bound is at it: times are whole nanoseconds."""
SIGNS = {"at_most": "≤", "at_least": "≥"}


def judge_limits(low: float, high: float, bound: float, direction: str) -> str:
    """Whether an interval keeps a bound: `met`, `not met` or `undecided`. `direction`: `at_most` or `at_least`."""
    if direction == "at_least":
        return judge_limits(-high, -low, -bound, "at_most")
    return MET if high <= bound + _SAME else NOT_MET if low > bound + _SAME else UNDECIDED


@dataclass(frozen=True)
class Verdict:
    """The verdict on a criterion in one configuration, of one `group` of a slice (empty: of all rows).

    `estimate`, `low`, `high`: of the metric, None where there is none; `interval`: their kind, None: no interval.
    `over`: what it is over, and how many `clusters`. `n`: rows. `why`: in words.
    """

    criterion: str
    configuration: str
    group: str
    metric: str
    against: str | None
    direction: str
    bound: float
    confidence: float
    population: str
    estimate: float | None
    low: float | None
    high: float | None
    interval: str | None
    over: str | None
    clusters: int | None
    n: int
    verdict: str
    passes: bool
    why: str

    @property
    def name(self) -> str:
        """The name of the criterion, with the group."""
        return f"{self.criterion}: {self.group}" if self.group else self.criterion

    @property
    def asked(self) -> str:
        """The bound: `known after (95 % by) ≤ 0.5 s`, `known after (mean) − that of PEM ≤ 0.05 s`."""
        metric = (METRIC | COMPARED).get(self.metric)
        words, _, unit = metric.header.partition(", ") if metric and metric.header else (self.metric, "", "")
        less = f" − that of {self.against}" if self.against else ""
        return f"{words}{less} {SIGNS[self.direction]} {format_cell(self.bound)} {unit.removesuffix('%')}".rstrip()

    @property
    def found(self) -> str:
        """The estimate in words; `never` for a quantile among the never detected."""
        never = self.estimate is None and self.interval is not None
        return "never" if never else format_cell(self.estimate)

    @property
    def limits(self) -> str:
        """The interval in words: `[0.5, 0.6]`; a dash on a side without limit."""
        if self.interval is None or (self.low is None and self.high is None):
            return "–"
        low, high = (math.nan if limit is None else limit for limit in (self.low, self.high))
        return format_limits(low, high)

    @property
    def result(self) -> str:
        """The verdict in words, and whether it passes where that does not follow."""
        return self.verdict if self.passes == (self.verdict == MET) else f"{self.verdict}, passes"


@dataclass(frozen=True)
class Judgement:
    """The verdicts of criteria on results. `place`: their name in messages. `notes`: what else has to be said.

    >>> verdicts = cr.judge("out/tc016d", {"known": {"metric": "detected_share", "at_least": 0.9}})
    >>> verdicts.passes, [(verdict.configuration, verdict.verdict) for verdict in verdicts.all[:1]]
    (False, [('PEM', 'not measured')])
    """

    place: str
    all: tuple[Verdict, ...]
    notes: tuple[str, ...] = ()

    @property
    def passes(self) -> bool:
        """Whether every verdict passes."""
        return all(verdict.passes for verdict in self.all)

    @property
    def table(self) -> pd.DataFrame:
        """A row per verdict, with its fields as columns."""
        return pd.DataFrame([asdict(verdict) for verdict in self.all], columns=[of.name for of in fields(Verdict)])

    def count(self) -> dict[str, int]:
        """How many verdicts there are of each kind."""
        counts = Counter(verdict.verdict for verdict in self.all)
        return {word: counts[word] for word in WORDS}

    @property
    def headline(self) -> str:
        """`3 of 5 verdicts pass: 2 met, 1 not met, 1 undecided, 1 not measured`."""
        passing = sum(verdict.passes for verdict in self.all)
        kinds = ", ".join(f"{number} {word}" for word, number in self.count().items() if number)
        return f"{passing} of {count_noun(len(self.all), 'verdict')} pass: {kinds}"

    @property
    def chance(self) -> str:
        """The number of verdicts that may be wrong by chance, as each is judged by itself."""
        levels = [verdict.confidence for verdict in self.all if verdict.over is not None and verdict.limits != "–"]
        wrong = sum((1 - level) / 2 for level in levels)
        return (
            f"{count_noun(len(levels), 'verdict')} by an interval, each by itself: were every metric at its bound, "
            f"about {wrong:.2g} would be met, and as many not met, by chance"
        )


# As text, and as files.


def verdicts_text(verdicts: Judgement, width: int | None = None) -> str:
    """The verdicts for a terminal of `width` characters; None: lines of any length."""
    grouped = any(verdict.group for verdict in verdicts.all)
    levels = {verdict.confidence for verdict in verdicts.all}
    limits = f"{100 * levels.pop():g} %" if len(levels) == 1 else "interval"
    rows = [
        {
            "criterion": verdict.criterion,
            **({"group": verdict.group} if grouped else {}),
            "configuration": verdict.configuration,
            "bound": verdict.asked,
            "found": verdict.found,
            limits: verdict.limits,
            "verdict": verdict.result,
        }
        for verdict in verdicts.all
    ]
    lines = [format_table(pd.DataFrame(rows), width)] if rows else []
    reasons: dict[tuple[str, str, str], list[str]] = {}
    for one in verdicts.all:
        if one.why and one.verdict != MET:
            reasons.setdefault((one.name, one.result, one.why), []).append(one.configuration)
    lines += [f"{name}, {', '.join(of)}: {result}: {why}" for (name, result, why), of in reasons.items()]
    return "\n".join([*lines, verdicts.chance, verdicts.headline])


def verdicts_markdown(verdicts: Judgement) -> str:
    """The verdicts as a table in Markdown, for the summary page of a job."""
    head = ("criterion", "configuration", "bound", "found", "interval", "verdict", "")
    lines = [f"### {escape_markdown(verdicts.place)}: {verdicts.headline}", ""]
    lines += [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for one in verdicts.all:
        result = escape_markdown(one.result) if one.passes else f"**{escape_markdown(one.result)}**"
        cells = (one.name, one.configuration, one.asked, one.found, one.limits)
        lines.append(f"| {' | '.join(map(escape_markdown, cells))} | {result} | {escape_markdown(one.why)} |")
    return "\n".join([*lines, "", f"{escape_markdown(verdicts.chance)}.", ""])


def verdicts_junit(verdicts: Judgement) -> str:
    """The verdicts as JUnit XML: a test case for each, in a suite named as the results are.

    Not met is a failure; undecided a failure of that type, or skipped where it passes; not measured an error, or
    skipped.
    """
    tags = {id(verdict): _junit_tag(verdict) for verdict in verdicts.all}
    counts = Counter(tags.values())
    numbers = {"tests": str(len(verdicts.all)), "failures": str(counts["failure"]), "errors": str(counts["error"]),
               "skipped": str(counts["skipped"]), "time": "0"}  # fmt: skip
    root = ElementTree.Element("testsuites", {"name": "copem-replay", **numbers})
    suite = ElementTree.SubElement(root, "testsuite", {"name": escape_unprintable(verdicts.place), **numbers})
    for verdict in verdicts.all:
        names = {"name": verdict.name, "classname": verdict.configuration}
        about = {key: escape_unprintable(name) for key, name in names.items()} | {"time": "0"}
        case = ElementTree.SubElement(suite, "testcase", about)
        says = f"{verdict.asked}: found {verdict.found} {verdict.limits}; {verdict.why}".rstrip("; ")
        says = escape_unprintable(says)
        if tag := tags[id(verdict)]:
            kind = {} if tag == "skipped" else {"type": verdict.verdict}
            ElementTree.SubElement(case, tag, {"message": f"{verdict.verdict}: {says}", **kind})
        else:
            ElementTree.SubElement(case, "system-out").text = says
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _junit_tag(verdict: Verdict) -> str:
    if verdict.verdict == MET:
        return ""
    if verdict.passes:
        return "skipped"
    return "error" if verdict.verdict == NOT_MEASURED else "failure"


def verdicts_jsonl(verdicts: Judgement) -> str:
    """The verdicts as JSON lines; the last one has the total, and a digest of the lines before it."""
    lines = [json.dumps(asdict(verdict), ensure_ascii=False) for verdict in verdicts.all]
    total = {
        "verdicts": len(verdicts.all),
        **verdicts.count(),
        "passes": verdicts.passes,
        "sha256": _digest_lines(lines),
    }
    return "\n".join([*lines, json.dumps({"total": total}, ensure_ascii=False)]) + "\n"


def _digest_lines(lines: Iterable[str]) -> str:
    return hashlib.sha256("".join(f"{line}\n" for line in lines).encode()).hexdigest()


FORMS: dict[str, Callable[[Judgement], str]] = {
    "jsonl": verdicts_jsonl,
    "junit": verdicts_junit,
    "markdown": verdicts_markdown,
}
"""The forms that verdicts are written in, by the options that name a file."""


def check_verdict_files(files: Mapping[str, Path | None]) -> None:
    """Raise OutputError for files, by their forms, that may not be written, before anything is judged."""
    check_outputs({f"--{form}": path for form, path in files.items()})
    for path in files.values():
        if path is not None:
            check_output(path)


def write_verdicts(verdicts: Judgement, path: Path, form: str = "jsonl") -> Path:
    """Write verdicts as a file, complete or not at all; an existing one is replaced. Raises OutputError."""
    with made_file(path, path.parent.resolve()) as scratch:
        scratch.write_text(FORMS[form](verdicts), encoding="utf-8", newline="\n")
    return path


# Read back.


def read_verdicts(path: Path) -> Judgement:
    """The verdicts of a file in JSON lines. Raises InputError, one line, where it is not as it was written."""
    try:
        lines = path.read_text(encoding="utf-8").removesuffix("\n").split("\n")  # names may have other ends of lines
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "no text in UTF-8"
        raise InputError(f"{path}: expected verdicts, found none that can be read: {why}") from None
    try:
        *rows, last = [parse_json(line) for line in lines]
        verdicts = Judgement(path.parent.name, tuple(_parse_verdict(k, row) for k, row in enumerate(rows, start=1)))
        total = {"verdicts": len(rows), **verdicts.count(), "passes": verdicts.passes}
        stored = dict(last["total"])
        digest = stored.pop("sha256")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected verdicts as they were written, found damage: {why}; {_JUDGE}") from None
    if stored != total:
        raise InputError(f"{path}: expected a total of {total}, found {stored}; {_JUDGE}")
    if digest != _digest_lines(lines[:-1]):
        raise InputError(f"{path}: expected the lines that were written, found others (SHA-256); {_JUDGE}")
    return verdicts


_JUDGE = f"`copem-replay verdict` writes them again ({AGAIN} for other results)"
_KINDS: dict[str, tuple[type, ...]] = {
    "str": (str,), "float": (float, int), "int": (int,), "bool": (bool,),
}  # fmt: skip


def _parse_verdict(number: int, row: Any) -> Verdict:
    """The verdict of one JSON line, checked against its own limits. Raises ValueError, KeyError, TypeError."""
    for column in fields(Verdict):
        value, kinds = row[column.name], [kind.strip() for kind in str(column.type).split("|")]
        allowed_types = [one for kind in kinds for one in _KINDS.get(kind, ())]
        if not (value is None and "None" in kinds) and type(value) not in allowed_types:
            raise ValueError(f"line {number}: {column.name}: expected {' or '.join(kinds)}, found {value!r}")
    verdict = Verdict(**row)
    expected = {verdict.verdict} & {*WORDS}
    if verdict.low is not None or verdict.high is not None:
        low, high = (
            infinite if limit is None else limit
            for limit, infinite in ((verdict.low, -math.inf), (verdict.high, math.inf))
        )
        expected = {judge_limits(low, high, verdict.bound, verdict.direction)}
    if verdict.verdict not in expected or verdict.direction not in SIGNS or not math.isfinite(verdict.bound):
        raise ValueError(
            f"line {number}: verdict: expected {' '.join(expected) or 'a verdict'}, found {verdict.verdict}"
        )
    if (verdict.verdict == MET and not verdict.passes) or (verdict.verdict == NOT_MET and verdict.passes):
        raise ValueError(f"line {number}: passes: {verdict.passes} of a criterion that is {verdict.verdict}")
    return verdict


def find_verdicts(folder: Path) -> Judgement | None:
    """The verdicts in a results folder; None: there are none. Raises InputError where they are damaged."""
    return read_verdicts(folder / FILE) if (folder / FILE).is_file() else None
