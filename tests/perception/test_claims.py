"""What entries say beside their states: confused classes, existence scores, track ids."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from copem_replay.core.tracks import CLASSES
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.perception.config import ClockError, Outages, PoseError
from copem_replay.perception.pem.condition import ExistenceScores
from copem_replay.perception.pem.model import (
    AreaPlace,
    FieldPlace,
    GhostModel,
    GivenPlaces,
    ListedClasses,
    ObjectSidePlace,
    Pem,
    TrackIds,
    draw_classes,
)
from copem_replay.perception.perceive import EntryClaims, draw_claims, make_draws
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers import scenes
from tests.helpers.experiments import changed, source_of
from tests.helpers.replays import study_rows, world_of
from tests.helpers.scenes import SEES_ALL, Thing, experiment, standing

PEDESTRIAN, BICYCLE = CLASSES.index("pedestrian"), CLASSES.index("bicycle")
MAST = {"at": [0.0, 0.0], "height_m": 5.0, "pem": "eyes"}


MEASURE = {"onset": {"kind": "appears"}, "distance_to": "mast"}


def plan_of(pem: dict[str, Any], **changes: Any) -> Experiment:
    fused = {"units": "all", "fusion": {"kind": "gnn"}}
    return experiment(
        pems={"eyes": {"couples": SEES_ALL} | pem},
        units={"mast": MAST},
        configurations={"GT": {"units": "truth"}, "ideal": {"units": "all"}, "gnn": fused},
        measure=MEASURE,
        **changes,
    )


def standing_child(until_s: float = 20.0) -> Recording:
    return scenes.recording([Thing("child", "pedestrian", standing(20, 0))], until_s=until_s, ego=None)


def claims(plan: Experiment, recording: Recording, runs: int) -> tuple[list[EntryClaims], Replay]:
    """By run what a unit says of a child in each of its lists."""
    replay = prepare_log(recording, plan)
    found = world_of(replay, plan).observations
    by_run = [
        draw_claims(found, replay.expanded, make_draws(replay.scene, found, replay.expanded, np.array([k])))
        for k in range(runs)
    ]
    return by_run, replay


class TestClasses:
    CONFUSED = {"classes": {"confusion": {"pedestrian": {"pedestrian": 0.9, "bicycle": 0.1}}, "confidence": 0.8}}  # noqa: RUF012

    def test_frequencies_and_confidence(self) -> None:
        [one], _ = claims(plan_of(self.CONFUSED), standing_child(500.0), 1)
        listed = one.class_probability.argmax(axis=1)
        assert np.bincount(listed, minlength=len(CLASSES))[[PEDESTRIAN, BICYCLE]].sum() == len(listed) == 5001
        assert (listed == BICYCLE).mean() == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / 5001))
        assert np.allclose(one.class_probability.max(axis=1), 0.8)
        assert np.allclose(one.class_probability.min(axis=1), 0.2 / (len(CLASSES) - 1))

    def test_it_lasts_as_its_memory_says(self) -> None:
        memory = {"memory": {"class": [{"share": 1.0, "correlation_s": "always"}]}}
        by_run, _ = claims(plan_of(self.CONFUSED | memory), standing_child(2.0), 400)
        taken = np.array([one.class_probability.argmax(axis=1) for one in by_run])
        assert (taken == taken[:, :1]).all()
        assert (taken[:, 0] == BICYCLE).mean() == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / 400))

    def test_classes_that_are_not_named_are_told(self) -> None:
        rows = ListedClasses.model_validate({"confusion": {"car": {"van": 1.0}}})
        every = np.arange(len(CLASSES))
        told = rows.listed(every, np.full(len(CLASSES), 0.999999))
        assert told.tolist() == [CLASSES.index("van") if k == CLASSES.index("car") else k for k in every]

    def test_what_rounding_leaves_is_no_class_that_is_not_there(self) -> None:
        row = np.zeros((1, len(CLASSES)))
        row[0, :3] = [0.1, 0.2, 0.7]
        top = 1 - 2.0**-53
        assert draw_classes(row, np.zeros(1, dtype=int), np.array([top])).tolist() == [2]

    def test_a_number_on_a_bound_draws_the_class_above_it(self) -> None:
        row = np.zeros((1, len(CLASSES)))
        row[0, 1:3] = [0.25, 0.75]
        uniform = np.array([0.0, 0.2499, 0.25])
        assert draw_classes(row, np.zeros(3, dtype=int), uniform).tolist() == [1, 1, 2]

    def test_ideal_fusion_keeps_the_true_class(self) -> None:
        sure, wrong = plan_of({}), plan_of({"classes": {"confusion": {"pedestrian": {"car": 1.0}}}})
        told, mistaken = (
            study_rows(run_experiment(sure, [standing_child(2.0)])),
            study_rows(run_experiment(wrong, [standing_child(2.0)])),
        )
        of = told["configuration"].isin(["GT", "ideal"])
        assert told[of].equals(mistaken[of])
        assert told[~of]["detected"].all()
        assert not mistaken[~of]["detected"].any()  # a car is no pedestrian


class TestScores:
    SCORES = {"kind": "scores", "real": [8, 2], "ghost": [2, 4]}  # noqa: RUF012

    def test_distributions(self) -> None:
        scores = ExistenceScores.model_validate(self.SCORES)
        uniform = (np.arange(10_000) + 0.5) / 10_000
        for of_ghosts, shape in ((False, (8, 2)), (True, (2, 4))):
            drawn = scores.claimed(uniform, of_ghosts=of_ghosts, ghosts_in_list=1.0)
            assert np.abs(drawn - stats.beta.ppf(uniform, *shape)).max() < 5e-3
            assert stats.kstest(drawn, stats.beta(*shape).cdf).pvalue > 0.99

    def test_calibrated_is_the_posterior(self) -> None:
        """Two drawn values by hand: f1 = 8·9 e^7 (1 - e), f0 = 20 e (1 - e)^3, half a ghost to one real entry."""
        scores = ExistenceScores.model_validate(self.SCORES | {"calibrated": True})
        for e in (0.3, 0.7):
            f1, f0 = 72 * e**7 * (1 - e), 20 * e * (1 - e) ** 3
            u = stats.beta.cdf(e, 8, 2)
            claimed = scores.claimed(np.array([u]), of_ghosts=False, ghosts_in_list=0.5)
            assert claimed[0] == pytest.approx(f1 / (f1 + 0.5 * f0), abs=2e-3)

    def test_of_lists(self) -> None:
        couples = [SEES_ALL[0] | {"existence": self.SCORES}]
        [one], _ = claims(plan_of({"couples": couples}), standing_child(300.0), 1)
        assert stats.kstest(one.existence, stats.beta(8, 2).cdf).pvalue > 1e-3

    def test_it_lasts_as_its_memory_says(self) -> None:
        couples = [SEES_ALL[0] | {"existence": self.SCORES}]
        memory = {"existence": [{"share": 1.0, "correlation_s": 1.0}]}
        [one], _ = claims(plan_of({"couples": couples, "memory": memory}), standing_child(900.0), 1)
        lag1 = np.corrcoef(one.existence[:-1], one.existence[1:])[0, 1]
        assert lag1 == pytest.approx(math.exp(-0.1), abs=0.03)
        assert stats.kstest(one.existence[::70], stats.beta(8, 2).cdf).pvalue > 1e-3

    def test_a_share_of_its_memory_is_of_lists(self) -> None:
        """Two thirds of the lists claim the one number that lasts for the run, the others each a number of its own."""
        couples = [SEES_ALL[0] | {"existence": self.SCORES}]
        memory = {"existence": [{"share": 2 / 3, "correlation_s": "always"}]}
        [one], _ = claims(plan_of({"couples": couples, "memory": memory}), standing_child(300.0), 1)
        counts = np.unique(one.existence, return_counts=True)[1]
        assert counts.max() / 3001 == pytest.approx(2 / 3, abs=4 * math.sqrt(2 / 9 / 3001))
        assert np.sort(counts)[-2] == 1

    @pytest.mark.parametrize("calibrated", [True, False])
    def test_calibrated_scores_mean_what_they_say(self, calibrated: bool) -> None:
        """One child in every list and half a ghost; the union passes on what its unit says."""
        couples = [SEES_ALL[0] | {"existence": self.SCORES | {"calibrated": calibrated}}]
        field = {"kind": "field", "range_m": [30, 80]}
        plan = plan_of({"couples": couples, "ghosts": [{"in_list": 0.5, "where": field}]}, runs=4)
        union = experiment(configurations={"union": {"units": "all", "fusion": {"kind": "union"}}}).configurations
        plan = plan.model_copy(update={"configurations": union})
        summary = run_experiment(plan, [standing_child(300.0)]).summary
        assert (summary["existence_ece"].item() <= 0.01) == calibrated


class TestTrackIds:
    def test_mean_time_between_switches(self) -> None:
        by_run, _ = claims(plan_of({"tracks": {"lasts_s": 2.0}}), standing_child(200.0), 20)
        ids = np.array([one.track_id for one in by_run])
        assert (ids >= 0).all()
        assert ids.max() < 2**52
        switches = (np.diff(ids, axis=1) != 0).mean()  # in 0.1 s: 1 - e^(-0.1 / 2)
        expected = 1 - math.exp(-0.05)
        assert switches == pytest.approx(expected, abs=4 * math.sqrt(expected / ids.size))
        of_run = [np.unique(row) for row in ids]
        assert all(len(np.intersect1d(of_run[0], other)) == 0 for other in of_run[1:])
        # None comes back: there are as many ids as switches and one.
        assert [len(each) for each in of_run] == ((np.diff(ids, axis=1) != 0).sum(axis=1) + 1).tolist()

    def test_left_out_there_are_none(self) -> None:
        by_run, _ = claims(plan_of({}), standing_child(1.0), 1)
        assert (by_run[0].track_id == -1).all()


PEM = "  onboard: {couples: [{detection: {kind: constant, probability: 0.5}}], %s}"


FIELD = "ghosts: [{where: {kind: field, range_m: [0, 9]}, %s}]"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "classes: {confusion: {pedestrian: {pedestrian: 0.9}}}",
            "classes.confusion.pedestrian: sums to 0.9, expected 1",
        ),
        (FIELD % "in_list: 1, classes: {car: 0.5}", "ghosts[0].classes: sums to 0.5, expected 1"),
        (FIELD % "in_list: -1", "ghosts[0].in_list: expected at least 0, found -1"),
        (
            FIELD % "in_list: 1, lasts_s: 0.0001",
            "ghosts[0].lasts_s: expected 0 (others in every list) or at least 0.001, found 0.0001",
        ),
        (
            "ghosts: [{in_list: 1, where: {kind: anywhere}}]",
            "ghosts[0].where: kind: expected one of field, places, area, beside, or package.module:Class; found "
            "'anywhere'",
        ),
        ("ghosts: [{in_list: 1, where: {kind: beside, classes: [truck]}}]", "ghosts[0].where.within_m: missing"),
        ("tracks: {lasts_s: 0}", "tracks.lasts_s: expected at least 0.001, found 0"),
        ("trakcs: {lasts_s: 1}", "trakcs: unknown key; did you mean tracks?"),
    ],
)
def test_problems(tmp_path: Path, text: str, said: str) -> None:
    lines = changed().splitlines()
    first = lines.index("pems:")
    lines[first + 1 : lines.index("units:")] = [PEM % text]
    _, found = find_problems(source_of(tmp_path, "\n".join(lines)))
    assert [line.partition(": ")[2] for line in found] == [f"pems.onboard.{said}"]


def test_existence_is_a_number_or_scores(tmp_path: Path) -> None:
    text = changed().replace("onboard:\n", "onboard:\n", 1)
    for existence, said in (
        ("{kind: scores, real: [8, 2]}", "existence.ghost: missing"),
        ("2", "existence: expected at most 1, or 'visible_share', found 2"),
    ):
        wrong = text.replace("probability: 0.5}", f"probability: 0.5}}\n      existence: {existence}")
        _, found = find_problems(source_of(tmp_path, wrong))
        assert [line.partition(": ")[2] for line in found] == [f"pems.onboard[0].{said}"]


def test_what_is_not_said_is_not_written() -> None:
    pem = Pem.model_validate({"couples": SEES_ALL, "tracks": {"lasts_s": 20}})
    assert pem.model_dump(mode="json").keys() == {"couples", "tracks"}
    assert isinstance(Pem.model_validate(SEES_ALL).model_dump(mode="json"), list)


def test_the_guide_holds(tmp_path: Path) -> None:
    """The example of docs/guide/unit-errors.md is an experiment."""
    text = (Path(__file__).parents[2] / "docs/guide/unit-errors.md").read_text(encoding="utf-8")
    example = text.partition("```yaml\n")[2].partition("```")[0]
    whole = "version: 1\nlogs: [a.mcap]\nconfigurations: {all: {units: all, fusion: {kind: gnn}}}\n" + example
    (tmp_path / "a.mcap").touch()
    plan, found = find_problems(source_of(tmp_path, whole))
    assert found == []
    assert plan is not None
    every = (
        PoseError,
        ClockError,
        Outages,
        GhostModel,
        FieldPlace,
        GivenPlaces,
        AreaPlace,
        ObjectSidePlace,
        ListedClasses,
        ExistenceScores,
        TrackIds,
    )
    for key in {key for model in every for key in model.model_fields} - {"kind"}:
        assert key in text, key
