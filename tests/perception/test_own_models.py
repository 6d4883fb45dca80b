"""Models of a user's own: used like ours, and when they fail it is said whose failure it is."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import TimeChunk
from copem_replay.core.view_geometry import Errors, Noise, ViewGeometry
from copem_replay.fusion.interface import Inbox, StepFusion
from copem_replay.perception.pem.detection import DetectionModel
from copem_replay.perception.pem.error import ErrorModel
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from tests.helpers import scenes
from tests.helpers.scenes import experiment


class NearOnly(DetectionModel):
    """Seen up to a range, surely."""

    reach_m: float

    def probability(self, view: ViewGeometry) -> np.ndarray:
        return (view.range_m <= self.reach_m).astype(float)


class Crashes(DetectionModel):
    def probability(self, view: ViewGeometry) -> np.ndarray:
        return view.no_such_thing  # type: ignore[attr-defined, no-any-return]


class TooMany(DetectionModel):
    def probability(self, view: ViewGeometry) -> np.ndarray:
        return np.ones(len(view.range_m) + 1)


class Percent(DetectionModel):
    def probability(self, view: ViewGeometry) -> np.ndarray:
        return np.full(len(view.range_m), 90.0)


class Shifted(ErrorModel):
    """One metre to the east, always."""

    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        zero, n = 0 * noise("east"), len(view.range_m)
        return Errors(zero + 1.0, zero, np.full(n, 0.01), np.zeros(n), np.full(n, 0.01))


class Flat(ErrorModel):
    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        n = len(view.range_m)
        return Errors(np.zeros(n), np.zeros(n), np.ones(n), np.zeros(n), np.ones(n))


class Leaves(DetectionModel):
    def probability(self, view: ViewGeometry) -> np.ndarray:
        sys.exit("no model today")  # it leaves


class FailsDeeper(DetectionModel):
    """Fails within a library that it calls."""

    def probability(self, view: ViewGeometry) -> np.ndarray:
        return np.reshape(view.range_m, (7, 7, 7))  # here


class Unmakable(DetectionModel):
    how: str

    def model_post_init(self, context: Any) -> None:
        if self.how == "exits":
            sys.exit(3)
        raise {"fails": RuntimeError("no weights"), "reads": OSError(2, "No such file", "weights.bin")}[self.how]

    def probability(self, view: ViewGeometry) -> np.ndarray:
        return view.range_m


def line_of(text: str) -> int:
    """The line of this file that ends with a text."""
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    return next(k for k, line in enumerate(lines, 1) if line.endswith(text))


def plan(detection: Any, error: Any = None) -> Any:
    couple = {"detection": detection} | ({"error": error} if error else {})
    return experiment(pems={"sure": [couple]})


def test_own_models_are_used() -> None:
    log = scenes.oncoming_car()
    near = plan(
        {"kind": "tests.perception.test_own_models:NearOnly", "reach_m": 30},
        {"kind": "tests.perception.test_own_models:Shifted"},
    )
    ready = prepare_log(log, near)
    fused = tracks_of_run(ready, near, 0)["PEM"].fused
    first = np.flatnonzero(fused.valid[0])[0]
    assert fused.arrives_s[0, fused.frame_ix[first]] == pytest.approx(7.0), "30 m away at 7 s"
    assert fused.x_m[0, first] == pytest.approx(31.0)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("Crashes", r"AttributeError: .*no_such_thing.*test_own_models\.py:\d+"),
        ("TooMany", r"expected shape \(81,\), found \(82,\) \(.*test_own_models\.py:\d+\)$"),
        ("Percent", r"expected 0 … 1, found 90\.0 \(.*test_own_models\.py:\d+\)$"),
        ("Leaves", rf"SystemExit: no model today \(.*test_own_models\.py:{line_of('# it leaves')}\)$"),
        ("FailsDeeper", rf"ValueError: .* \(.*test_own_models\.py:{line_of('# here')}\)$"),
    ],
)
def test_a_detection_model_that_fails_is_named(kind: str, said: str) -> None:
    with pytest.raises(
        InputError, match=rf"^pems\.sure\[0\]\.detection: tests.perception.test_own_models:{kind}: .*{said}"
    ):
        prepare_log(scenes.oncoming_car(), plan({"kind": f"tests.perception.test_own_models:{kind}"})).observe(
            TimeChunk()
        )


def test_an_error_model_that_fails_is_named() -> None:
    wrong = plan({"kind": "constant", "probability": 1.0}, {"kind": "tests.perception.test_own_models:Flat"})
    ready = prepare_log(scenes.oncoming_car(), wrong)
    with pytest.raises(InputError, match=r"^pems\.sure\[0\]\.error: .*east_m: expected shape \(1, 81\), found \(81,\)"):
        tracks_of_run(ready, wrong, 0)


class Forgotten(DetectionModel):
    """Lacks its method."""


def test_a_model_without_its_method_is_refused() -> None:
    with pytest.raises(ValueError, match=r"tests.perception.test_own_models:Forgotten' lacks probability"):
        plan({"kind": "tests.perception.test_own_models:Forgotten"})


@pytest.mark.parametrize(
    ("how", "why", "where"),
    [
        ("exits", "SystemExit: 3", "sys.exit(3)"),
        ("fails", "RuntimeError: no weights", "[self.how]"),
        ("reads", r"FileNotFoundError: \[Errno 2\] No such file: 'weights.bin'", "[self.how]"),
    ],
)
def test_a_model_that_cannot_be_made_is_named(how: str, why: str, where: str) -> None:
    with pytest.raises(ValueError, match=rf"cannot be made: {why} \(.*test_own_models\.py:{line_of(where)}\)"):
        plan({"kind": "tests.perception.test_own_models:Unmakable", "how": how})


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("import sys\n\nsys.exit()\n", r"SystemExit \(.*/leaving\.py:3\)"),
        ("import json\njson.loads('{')\n", r"JSONDecodeError: .*"),
        ("import no_such_module_at_all\n", r"ModuleNotFoundError: .* \(.*/leaving\.py:1\)"),
    ],
)
def test_a_module_that_cannot_be_imported_says_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, why: str
) -> None:
    (tmp_path / "leaving.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=rf"kind: 'leaving:Model' cannot be imported: {why}") as error:
        plan({"kind": "leaving:Model"})
    assert "PYTHONPATH" not in str(error.value), "its folder was found"


class Number(StepFusion):
    """Gives no list."""

    kind: str = "tests.perception.test_own_models:Number"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> Any:  # the step
        return 3


def test_a_step_that_gives_something_else_is_named() -> None:
    own = {
        "GT": {"units": "truth"},
        "own": {"units": ["ego"], "fusion": {"kind": "tests.perception.test_own_models:Number"}},
    }
    wrong = scenes.experiment(configurations=own)
    said = r"^configurations\.own\.fusion: tests.perception.test_own_models:Number: "
    said += ".*step: expected a list and a memory, found int"
    said += rf" \(.*test_own_models\.py:{line_of('# the step')}\)$"
    with pytest.raises(InputError, match=said):
        tracks_of_run(prepare_log(scenes.oncoming_car(), wrong), wrong, 0)
