"""Links: when lists arrive, by ours and by one from outside the package, from the experiment to the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from copem_replay.communication.link import ConstantLink, LinkModel, SentLists, UnitLinks, transmit
from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.run import StudyTables, run_experiment
from copem_replay.pipeline.sweep import describe_unswept, list_points
from copem_replay.report import write_html_report
from tests.helpers import scenes
from tests.helpers.replays import study_rows
from tests.helpers.report_pages import Page, changed, replayed
from tests.helpers.scenes import experiment

HERE = "tests.communication.test_link"


class Filling(LinkModel):
    """A channel that fills up: every list takes longer than the one before."""

    base_s: float = 0.1
    per_s: float = 0.25

    def delays_s(self, lists: SentLists) -> Float:
        return (self.base_s + self.per_s * lists.sent_s)[None]


class Lossy(LinkModel):
    """Loses every list of a unit that was captured before an instant."""

    unit: str
    until_s: float

    def delays_s(self, lists: SentLists) -> Float:
        lost = (np.array(lists.units)[lists.unit_ix] == self.unit) & (lists.captured_s < self.until_s)
        return np.where(lost, np.inf, 0.0)[None]


class Wrong(LinkModel):
    how: str

    def delays_s(self, lists: SentLists) -> Float:
        n = len(lists.sent_s)
        return {  # type: ignore[no-any-return]
            "by run": np.zeros((2, n)),
            "flat": np.zeros(n),
            "few": np.zeros((1, n + 1)),
            "early": np.full((1, n), -0.1),
            "none": np.full((1, n), np.nan),
            "words": np.full((1, n), "late"),
            "no array": 0.5,
        }[self.how]


def linked(link: dict[str, Any], **changes: Any) -> Experiment:
    return experiment(configurations={"PEM": {"units": ["ego"], "link": link}}, **changes)


def outcome(plan: Experiment) -> StudyTables:
    return run_experiment(plan, [scenes.oncoming_car()])


class TestOneFromOutside:
    """The other car comes within 60 m at 4 s: that list takes 0.1 s + 0.25 · 4 s. At 5.1 s the car is 49 m away."""

    PLAN = linked({"kind": f"{HERE}:Filling"})

    def test_it_is_in_detections_and_summary(self) -> None:
        result = outcome(self.PLAN)
        [row] = study_rows(result).to_dict("records")
        assert (row["captured_s"], row["detection_s"]) == pytest.approx((4.0, 5.1))
        assert row["distance_at_detection_m"] == pytest.approx(49.0)
        [line] = result.summary.to_dict("records")
        assert line["ttd_median_s"] == pytest.approx(3.1)

    def test_where_times_are_exact(self) -> None:
        exact = outcome(self.PLAN.model_copy(update={"measure": self.PLAN.measure.model_copy(update={"exact": True})}))
        assert exact.exact is not None
        possible = exact.exact[exact.exact["probability"] > 0]
        assert possible["detection_s"].tolist()[:1] == pytest.approx([5.1])

    @pytest.mark.parametrize("fusion", ["ideal", "tracker"])
    def test_the_same_of_a_log_in_time_chunks(self, monkeypatch: pytest.MonkeyPatch, fusion: str) -> None:
        configurations = {"PEM": {"units": ["ego"], "link": {"kind": f"{HERE}:Filling"}, "fusion": {"kind": fusion}}}
        pems = {"sure": [{"detection": {"kind": "constant", "probability": 0.5},
                          "error": {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}}]}  # fmt: skip
        plan = experiment(configurations=configurations, pems=pems, runs=3)
        whole = outcome(plan)
        monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
        monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 40)
        cut = outcome(plan)
        assert len(cut.logs[0].replay().chunks) > 2
        assert study_rows(cut).equals(study_rows(whole))
        assert cut.summary.equals(whole.summary)

    def test_lists_that_are_lost(self) -> None:
        lossy = linked({"kind": f"{HERE}:Lossy", "unit": "ego", "until_s": 4.55})
        assert study_rows(outcome(lossy))["detection_s"].tolist() == pytest.approx([4.6])

    def test_it_is_in_the_results_and_the_report(self, tmp_path: Path) -> None:
        late = ("  late: {units: [ego], latency_s: 0.5}", f"  late: {{units: [ego], link: {{kind: '{HERE}:Filling'}}}}")
        folder = replayed(tmp_path, changed(late))
        text = (folder / "experiment.yaml").read_text(encoding="utf-8")
        assert f"{HERE}:Filling" in text
        assert text.count(" link:") == 1, "where there is none, none is written"
        write_html_report(folder, tmp_path / "report.html")
        page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
        assert any(f"{HERE}:Filling" in cell for row in page.rows["configurations"] for cell in row)

    def test_it_is_in_the_schema(self) -> None:
        schema = Experiment.model_json_schema()
        [link, none] = schema["$defs"]["Configuration"]["properties"]["link"]["anyOf"]
        [[radio, own], name, by_unit] = [link["oneOf"][0]["anyOf"], *link["oneOf"][1:]]
        assert (radio["properties"]["kind"]["const"], own["properties"]["kind"]["pattern"]) == ("radio", ":")
        assert (name["type"], by_unit["type"], none) == (["string", "integer"], "object", {"type": "null"})

    def test_written_and_read_back_it_is_the_same(self) -> None:
        assert Experiment.model_validate(self.PLAN.as_written()) == self.PLAN

    def test_a_sweep_of_latency_adds_to_it(self) -> None:
        plan = linked({"kind": f"{HERE}:Filling"}, sweep={"latency_s": [0, 1], "configurations": ["PEM"]})
        assert describe_unswept(plan) == []
        [swept] = [
            study_rows(outcome(point.experiment))["detection_s"] for point in list_points(plan) if point.value == 1
        ]
        assert swept.tolist() == pytest.approx([6.1])


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("by run", r"expected shape \(1, 81\), found \(2, 81\)"),
        ("flat", r"expected shape \(1, 81\), found \(81,\)"),
        ("few", r"expected shape \(1, 81\), found \(1, 82\)"),
        ("early", r"expected seconds of 0 or more \(inf: never\), found others"),
        ("none", r"expected seconds of 0 or more \(inf: never\), found others"),
        ("words", r"expected seconds of 0 or more \(inf: never\), found others"),
        ("no array", r"expected shape \(1, 81\), found float"),
    ],
)  # fmt: skip
def test_delays_that_cannot_be_used_are_refused(how: str, said: str) -> None:
    wrong = linked({"kind": f"{HERE}:Wrong", "how": how})
    with pytest.raises(
        InputError,
        match=rf"^configurations\.PEM\.link: {HERE}:Wrong: delays_s: {said} \(.*test_link\.py:\d+\)$",
    ):
        outcome(wrong)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"link": {"kind": "constant"}}, "kind: expected one of radio, or package.module:Class; found 'constant'"),
        ({"link": 0.5}, r"Input should be a valid string"),
        ({"link": {"kind": f"{HERE}:SentLists"}}, "is no kind of copem_replay.communication.link.LinkModel"),
    ],
)
def test_a_configuration_that_declares_no_link_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        experiment(configurations={"PEM": {"units": ["ego"]} | changes})


def test_constant_delays_by_unit_and_of_lists_that_are_not_heard() -> None:
    log = scenes.oncoming_car().truth
    names = ("a", "b", "c")
    seen = type(log)(**{**vars_of(log), "units": names, "frame_unit_ix": np.arange(81) % 3})
    link = ConstantLink(latency_s={"a": 0.5, "default": 0.25})
    found = transmit(seen, [UnitLinks("link", link)], {"a", "b"}).arrives_s - log.captured_s
    np.testing.assert_allclose(found, np.tile([0.5, 0.25, np.inf], 27)[None], atol=1e-12)
    assert [ConstantLink(latency_s={"a": 0.5}).fixed_s(name) for name in names] == [0.5, 0.0, 0.0]


def vars_of(of: Any) -> dict[str, Any]:
    return {name: getattr(of, name) for name in of.__dataclass_fields__}
