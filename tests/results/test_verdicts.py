"""Judgement as files: JSON lines and back, JUnit XML as others read it, Markdown; tampered ones are refused by name."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import pytest
import xmlschema
from hypothesis import given
from hypothesis import strategies as st
from junitparser import Error, Failure, JUnitXml, Skipped
from markdown_it import MarkdownIt

import copem_replay as cr
from copem_replay.results.verdicts import (
    FILE,
    MET,
    NOT_MEASURED,
    NOT_MET,
    UNDECIDED,
    WORDS,
    Judgement,
    Verdict,
    find_verdicts,
    judge_limits,
    read_verdicts,
    verdicts_jsonl,
    verdicts_junit,
    verdicts_markdown,
    verdicts_text,
    write_verdicts,
)

XSD = Path(__file__).parents[1] / "helpers" / "junit.xsd"
NAMED = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=20)


def verdict(word: str, *, passes: bool | None = None, **given: Any) -> Verdict:
    """A verdict of a bound of 0.5 with limits that go with it."""
    low, high = {MET: (0.1, 0.4), NOT_MET: (0.6, None), UNDECIDED: (0.3, 0.6), NOT_MEASURED: (None, None)}[word]
    columns: dict[str, Any] = {
        "criterion": "known soon", "configuration": "PEM", "group": "", "metric": "ttd_p95_s", "against": None,
        "direction": "at_most", "bound": 0.5, "confidence": 0.95, "population": "such_traffic", "estimate": low,
        "low": low, "high": high, "interval": None if low is None else "inverted",
        "over": None if low is None else "logs", "clusters": None if low is None else 8, "n": 80, "verdict": word,
        "passes": word == MET if passes is None else passes, "why": "as is" if word != MET else "",
    }  # fmt: skip
    return Verdict(**columns | given)


ALL = Judgement(
    "out",
    (
        *(verdict(word, criterion=f"is {word}") for word in WORDS),
        verdict(UNDECIDED, passes=True, criterion="undecided, which passes"),
        verdict(NOT_MEASURED, passes=True, criterion="absent, which passes"),
        verdict(MET, criterion='a <b> & "c" | d', group="pedestrian", configuration="co:PEM 'x'"),
    ),
)

some = st.lists(
    st.builds(
        lambda word, name, group, passes: verdict(
            word, criterion=name, group=group, passes=word == MET or (passes and word != NOT_MET)
        ),
        st.sampled_from(WORDS), NAMED, st.just("") | NAMED, st.booleans(),
    ), max_size=8,
)  # fmt: skip


@given(some)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, of: list[Verdict]) -> None:
    folder = tmp_path_factory.mktemp("folder")
    written = Judgement(folder.name, tuple(of))
    write_verdicts(written, folder / FILE)
    assert find_verdicts(folder) == written
    assert (folder / FILE).read_text() == verdicts_jsonl(written)


def test_a_link_to_itself_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / FILE
    path.symlink_to(FILE)
    assert read_verdicts(write_verdicts(ALL, path)).all == ALL.all
    assert not path.is_symlink()


def test_a_folder_without_verdicts_has_none(tmp_path: Path) -> None:
    assert find_verdicts(tmp_path) is None


def change_row(change: dict[str, Any]) -> Any:
    def changed(lines: list[str]) -> list[str]:
        return [json.dumps(json.loads(lines[0]) | change, ensure_ascii=False), *lines[1:]]

    return changed


TAMPERED = {
    "a verdict turned": (change_row({"verdict": "not met"}), "line 1: verdict: expected met, found not met"),
    "a word of its own": (change_row({"verdict": "fine"}), "line 1: verdict: expected met, found fine"),
    "a limit moved": (change_row({"high": 0.45}), "SHA-256"),
    "a limit beyond the bound": (change_row({"high": 0.9}), "line 1: verdict: expected undecided"),
    "a text for a number": (change_row({"low": "0.1"}), "line 1: low: expected float or None, found '0.1'"),
    "true for a number": (change_row({"bound": True}), "line 1: bound: expected float, found True"),
    "passes turned": (change_row({"passes": False}), "passes: False of a criterion that is met"),
    "a line left out": (lambda lines: lines[1:], "expected a total of"),
    "two lines exchanged": (lambda lines: [lines[1], lines[0], *lines[2:]], "SHA-256"),
    "the total left out": (lambda lines: lines[:-1], "no 'total'"),
    "cut off": (lambda lines: [*lines[:-1], lines[-1][:20]], "found damage"),
    "another key": (lambda lines: ['{"criterion": "x"}', *lines[1:]], "no 'configuration'"),
    "no JSON": (lambda lines: ["nonsense", *lines[1:]], "found damage"),
    "nothing": (lambda lines: [], "found damage"),
    "a list": (lambda lines: ["[]", *lines[1:]], "found damage"),
}


@pytest.mark.parametrize("how", TAMPERED)
def test_tampered_ones_are_refused_by_name(tmp_path: Path, how: str) -> None:
    change, says = TAMPERED[how]
    path = write_verdicts(ALL, tmp_path / FILE)
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    with pytest.raises(cr.InputError) as caught:
        read_verdicts(path)
    assert str(path) in str(caught.value)
    assert says in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_names_with_ends_of_lines_and_controls_are_one_name(tmp_path: Path) -> None:
    """Groups are named after drives, whose files may be called anything."""
    of = Judgement("a\x01b", (verdict(MET, group="one\u2028two\x85three\x01"),))
    assert read_verdicts(write_verdicts(of, tmp_path / FILE)).all == of.all
    (suite,) = JUnitXml.fromstring(verdicts_junit(of).encode())
    assert (suite.name, [case.name for case in suite]) == ("a\\x01b", ["known soon: one\\u2028two\\x85three\\x01"])


# ------------------------------------------------------------------------------------------- JUnit


def test_junit_is_read_as_it_is_meant() -> None:
    xml = verdicts_junit(ALL)
    suites = JUnitXml.fromstring(xml.encode())
    assert (suites.tests, suites.failures, suites.errors, suites.skipped) == (7, 2, 1, 2)
    (suite,) = suites
    assert suite.name == "out"
    cases = {case.name: case for case in suite}
    assert len(cases) == len(ALL.all)
    kinds = {name: [type(one) for one in case.result] for name, case in cases.items()}
    assert kinds == {
        "is met": [],
        "is not met": [Failure],
        "is undecided": [Failure],
        "is not measured": [Error],
        "undecided, which passes": [Skipped],
        "absent, which passes": [Skipped],
        'a <b> & "c" | d: pedestrian': [],
    }
    assert cases["is undecided"].result[0].type == "undecided"
    assert cases['a <b> & "c" | d: pedestrian'].classname == "co:PEM 'x'"


@given(some)
def test_counts_of_junit_are_right_and_its_schema_holds(of: list[Verdict]) -> None:
    verdicts = Judgement("out", tuple(of))
    xml = verdicts_junit(verdicts)
    xmlschema.XMLSchema(str(XSD)).validate(io.StringIO(xml))
    (suite,) = JUnitXml.fromstring(xml.encode())
    counted = (suite.tests, suite.failures, suite.errors, suite.skipped)
    suite.update_statistics()
    assert counted == (suite.tests, suite.failures, suite.errors, suite.skipped)
    assert suite.failures + suite.errors == sum(not one.passes for one in of)


# ------------------------------------------------------------------------------- Markdown and the terminal


@given(some)
def test_a_row_of_markdown_for_each(of: list[Verdict]) -> None:
    html = MarkdownIt("commonmark").enable("table").render(verdicts_markdown(Judgement("out", tuple(of))))
    assert html.count("<tr>") == 1 + len(of)
    assert html.count("<strong>") == sum(not one.passes for one in of)


def test_the_table_says_what_fails_and_why() -> None:
    text = verdicts_text(ALL)
    assert "4 of 7 verdicts pass: 2 met, 1 not met, 2 undecided, 2 not measured" in text
    assert "is undecided, PEM: undecided: as is" in text
    assert "undecided, passes" in text
    # Five verdicts by an interval at 95 %: 5 × .025.
    assert "5 verdicts by an interval, each by itself: were every metric at its bound, about 0.13 would" in text
    assert not ALL.passes


def test_never_is_said_of_a_quantile_that_is_not_reached() -> None:
    one = verdict(NOT_MET, estimate=None)
    assert (one.found, one.limits) == ("never", "[0.6, –]")
    assert judge_limits(0.6, math.inf, 0.5, "at_most") == NOT_MET


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [
        (0.1, 0.5, MET),
        (0.1, 0.5 + 5e-10, MET),  # times are whole nanoseconds: it is the bound
        (0.1, 0.5 + 2e-9, UNDECIDED),
        (0.5, 0.5, MET),
        (0.5, 0.6, UNDECIDED),
        (0.5 + 5e-10, 0.6, UNDECIDED),
        (0.5 + 2e-9, 0.6, NOT_MET),
    ],
)
def test_a_limit_at_the_bound_keeps_it(low: float, high: float, word: str) -> None:
    assert judge_limits(low, high, 0.5, "at_most") == word
    assert judge_limits(1 - high, 1 - low, 0.5, "at_least") == word
