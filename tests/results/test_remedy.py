"""What would help the configuration that knows an object last, of rows written down by hand."""

from __future__ import annotations

import pandas as pd
import pytest

from copem_replay.results.remedy import tell_what_helps
from tests.helpers.scenes import experiment


def helps(known_s: dict[str, float | None]) -> str:
    """The sentence on an object that configurations know after some seconds; None: never."""
    units = {name: {"at": [0, k], "height_m": 5.0, "pem": "sure"} for k, name in enumerate(("m1", "m2", "m3", "m4"))}
    given = experiment(
        units=units,
        links={"radio": {"latency": 0.1}},
        configurations={
            "GT": {"units": "truth"},
            "one": {"units": ["m1"]},
            "two": {"units": ["m1", "m2"]},
            "all": {"units": "all"},
            "late": {"units": "all", "latency_s": 1.5},
            "gnn": {"units": "all", "fusion": {"kind": "gnn"}},
            "air": {"units": "all", "link": "radio"},
            "other": {"units": ["m3", "m4"], "fusion": {"kind": "gnn"}, "latency_s": {"default": 0.5}},
        },
    )
    return tell_what_helps(
        given, pd.DataFrame({"configuration": [*known_s], "time_to_detection_s": [*known_s.values()]})
    )


@pytest.mark.parametrize(
    ("known_s", "change"),
    [
        ({"all": 0.2, "late": 1.7}, "late: without the 1.5 s of latency (all): known 1.50 s earlier"),
        (
            {"two": 0.2, "one": None},
            "one: the lists of m2 as well (two): known after 0.20 s instead of never",
        ),
        ({"two": 0.9, "all": 0.0}, "two: the lists of m3, m4 as well (all): known 0.90 s earlier"),
        ({"one": 0.1, "two": 0.4}, "two: the lists of m1 instead (one): known 0.30 s earlier"),
        ({"all": 0.1, "gnn": 0.4}, "gnn: fusion ideal instead of gnn (all): known 0.30 s earlier"),
        ({"all": 0.1, "air": 0.4}, "air: no link (all): known 0.30 s earlier"),
        ({"air": 0.1, "all": 0.4}, "all: another link (air): known 0.30 s earlier"),
        ({"two": 0.1, "all": 0.0, "one": 3.0}, "one: the lists of m2, m3, m4 as well (all): known 3.00 s earlier"),
        (
            {"other": None, "one": None, "two": 1.0},
            "one: the lists of m2 as well (two): known after 1.00 s instead of never",
        ),
        # With more units more keys may differ; fewer come first.
        (
            {"one": 3.0, "gnn": 0.5},
            "one: the lists of m2, m3, m4 as well (and another fusion) (gnn): known 2.50 s earlier",
        ),
        (
            {"other": None, "air": 0.5},
            "other: the lists of m1, m2 as well (and another link and latency and fusion) (air): known "
            "after 0.50 s instead of never",
        ),
        ({"one": 3.0, "gnn": 0.0, "two": 1.0}, "one: the lists of m2 as well (two): known 2.00 s earlier"),
    ],
)
def test_one_key_of_another_configuration_would_help(known_s: dict[str, float | None], change: str) -> None:
    assert helps(known_s) == f"What would help {change}."


@pytest.mark.parametrize(
    "known_s",
    [
        {},
        {"one": 0.3},
        {"GT": 0.0, "one": 0.3},
        {"all": 0.3, "late": 0.3},
        {"late": None, "all": None},
        {"other": 2.0, "one": 0.0},  # it has other units, and more keys are different
        {"late": 1.0, "gnn": 0.0},
    ],
)
def test_what_would_help_is_not_made_up(known_s: dict[str, float | None]) -> None:
    assert helps(known_s) == ""
