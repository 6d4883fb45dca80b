"""Radio links by themselves: laws of latency and loss, bursts, order and queue, against distributions of SciPy."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from scipy import stats

import copem_replay as cr
from copem_replay.communication.latency import Delay, LatencyModel
from copem_replay.communication.link import LinkInput, SentLists
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import RadioPath, ReceptionModel
from copem_replay.core.lasting import ListStamps, draw_dwelling_uniforms
from copem_replay.core.memory import UnitDraws
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Float

T0_NS = 1_700_000_000_000_000_000


def lists(count: int, period_s: float = 0.1, units: int = 1, run: int = 0, **more: Any) -> SentLists:
    """So many lists of each unit, which are sent when they are captured."""
    captured_s = np.tile(np.arange(count) * period_s, units)
    unit_ix = np.repeat(np.arange(units), count)
    names = tuple(f"u{k}" for k in range(units))
    stamp_ns = T0_NS + np.rint(captured_s * 1e9).astype(np.int64)
    key = RandomKey(names, unit_ix, np.full(len(unit_ix), 7, dtype=np.uint64), stamp_ns)
    draws = UnitDraws(
        CounterRng(1, "log"), key, ListStamps(stamp_ns, unit_ix, np.arange(len(unit_ix))), np.array([run])
    )
    air = LinkInput(draws, more.pop("path", None), more.pop("objects", None))
    return replace(SentLists(names, unit_ix, captured_s, captured_s, air=air), **more)


def radio(**keys: Any) -> Radio:
    return Radio.model_validate(keys)


def latency(value: object) -> LatencyModel:
    found: LatencyModel = TypeAdapter(Delay).validate_python(value)
    return found


def gilbert_elliott(bad_share: float, bad_lasts_s: float, **more: float) -> dict[str, Any]:
    return {"kind": "gilbert_elliott", "bad_share": bad_share, "bad_lasts_s": bad_lasts_s, **more}


class TestLatency:
    @pytest.mark.parametrize(
        ("model", "law"),
        [
            ({"kind": "gamma", "min_s": 0.02, "mean_s": 0.06, "shape": 2}, stats.gamma(2, loc=0.02, scale=0.02)),
            ({"kind": "lognormal", "min_s": 0.01, "median_s": 0.05, "sigma": 0.7}, stats.lognorm(0.7, 0.01, 0.05)),
        ],
    )
    def test_the_law_is_that_of_scipy(self, model: dict[str, Any], law: Any) -> None:
        delay_s = radio(latency=model).delays_s(lists(20_000))[0]
        assert stats.kstest(delay_s, law.cdf).pvalue > 1e-3
        q = np.array([0.001, 0.5, 0.999])
        np.testing.assert_allclose(latency(model).delays(q), law.ppf(q), rtol=1e-9)

    def test_a_number_is_a_constant(self) -> None:
        assert latency(0.25) == latency({"kind": "constant", "s": 0.25})
        assert radio(latency=0.25).delays_s(lists(3)).tolist() == [[0.25] * 3]
        assert not radio(latency=0.25).drawn

    def test_larger_models_are_later_list_by_list(self) -> None:
        means = (0.05, 0.08, 0.2)
        found = [radio(latency={"kind": "gamma", "mean_s": m, "shape": 2}).delays_s(lists(500)) for m in means]
        assert (found[0] < found[1]).all()
        assert (found[1] < found[2]).all()

    def test_of_the_mean_no_less_than_the_least(self) -> None:
        with pytest.raises(ValidationError, match=r"mean_s: expected more than min_s \(0.1\), found 0.1"):
            latency({"kind": "gamma", "min_s": 0.1, "mean_s": 0.1, "shape": 2})


class TestReception:
    """Shadowing as in Sepulcre 2022, with their path loss and receiver: 20 dBm, −85 dBm, σ 3 dB."""

    @staticmethod
    def margin_db(distance_m: float) -> float:
        """What is left of their power at −85 dBm: WINNER+ B1 beyond the break point of 79 m, with heights of 1 m."""
        return 20 + 85 - (40 * math.log10(distance_m) + 9.45 + 2.7 * math.log10(5.9 / 5))

    @pytest.mark.parametrize(("distance_m", "expected"), [(200.0, 0.8657), (300.0, 0.1072)])
    def test_the_curve_is_an_error_function(self, distance_m: float, expected: float) -> None:
        margin_db = self.margin_db(distance_m)
        half_at_m = distance_m * 10 ** (margin_db / 40)  # 40 lg(d₅₀ / d) is that margin
        model = {"kind": "shadowing", "half_at_m": half_at_m, "exponent": 4.0, "sigma_db": 3.0}
        [found] = probability(model, [distance_m])
        assert found == pytest.approx(0.5 * (1 + math.erf(margin_db / 3 / math.sqrt(2))), abs=1e-12)
        assert found == pytest.approx(expected, abs=5e-4)

    def test_half_at_its_distance_less_where_blocked_and_no_more_when_near(self) -> None:
        model = {"kind": "shadowing", "half_at_m": 100, "exponent": 2.27, "sigma_db": 3, "blocked_db": 9}
        free, blocked, far = probability(model, [100.0, 100.0, math.inf], [1.0, 0.04, 1.0])
        assert (free, far) == (0.5, 0.0)
        assert blocked == pytest.approx(stats.norm.cdf(-3))
        assert probability(model, [0.0]) == probability(model, [3.0])

    def test_tables_are_linear_between_their_values(self) -> None:
        assert probability({"kind": "table", "distance_m": [0, 100], "probability": [1.0, 0.5]}, [50.0, 400.0]) == [
            0.75,
            0.5,
        ]
        by_share = {
            "kind": "table",
            "distance_m": [0, 100],
            "visible_share": [0, 1],
            "probability": [[0.8, 1], [0, 0.6]],
        }
        assert probability(by_share, [50.0], [0.5]) == pytest.approx([0.6])

    def test_what_is_lost_with_a_probability(self) -> None:
        lost = np.isinf(radio(reception={"kind": "constant", "probability": 0.7}).delays_s(lists(20_000)))
        assert lost.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / 20_000))

    @given(st.lists(st.integers(0, 100), min_size=2, max_size=2).map(sorted))
    def test_more_loss_only_removes_lists(self, percent: list[int]) -> None:
        less, more = (
            radio(latency={"kind": "gamma", "mean_s": 0.3, "shape": 1}, order="kept",
                  reception={"kind": "constant", "probability": 1 - loss / 100}).delays_s(lists(200))
            for loss in percent
        )  # fmt: skip
        there = np.isfinite(more)
        assert (more[there] == less[there]).all()

    @given(st.lists(st.integers(0, 100), min_size=2, max_size=2).map(sorted), st.sampled_from([0.05, 0.5, 20.0]))
    def test_a_larger_bad_share_only_removes_lists(self, percent: list[int], lasts_s: float) -> None:
        less, more = (radio(reception=gilbert_elliott(share / 100, lasts_s)).delays_s(lists(300)) for share in percent)
        assert (np.isfinite(more) <= np.isfinite(less)).all()


def probability(model: dict[str, Any], distance_m: list[float], share: list[float] | None = None) -> list[float]:
    path = RadioPath(np.array(distance_m), np.array(share or [1.0] * len(distance_m)))
    found: Float = radio(reception=model).received(lists(len(distance_m), path=path))
    return found.tolist()


class TestBursts:
    """Gilbert–Elliott in the classical form: .05 and .25 a list, at 10 Hz."""

    PERIOD_S = 0.1
    TAU_S = -PERIOD_S / math.log(0.7)
    SHARE = 1 / 6
    LASTS_S = TAU_S / (1 - SHARE)

    def lost(self, count: int, lasts_s: float, share: float, run: int = 0) -> Any:
        one = radio(reception=gilbert_elliott(share, lasts_s))
        return np.isinf(one.delays_s(lists(count, self.PERIOD_S, run=run))[0])

    def test_loss_and_lengths_of_bursts(self) -> None:
        assert pytest.approx(0.2804, abs=1e-4) == self.TAU_S
        lost = self.lost(200_000, self.LASTS_S, self.SHARE)
        assert lost.mean() == pytest.approx(0.16667, abs=0.004)
        assert lost[1:][lost[:-1]].mean() == pytest.approx(0.75, abs=0.01)  # stays bad: 1 − .25
        assert lost[1:][~lost[:-1]].mean() == pytest.approx(0.05, abs=0.003)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
        length = edges[1::2] - edges[::2]
        most = 15
        counted = np.bincount(np.minimum(length, most), minlength=most + 1)[1:]
        geometric = np.append(0.25 * 0.75 ** np.arange(most - 1), 0.75 ** (most - 1))
        assert stats.chisquare(counted, geometric * len(length)).pvalue > 1e-3

    def test_extra_lists_before_the_first_that_arrives(self) -> None:
        waits = []
        for run in range(4000):
            lost = self.lost(60, self.LASTS_S, self.SHARE, run)
            waits.append(int(np.argmin(lost)))
        expected = self.SHARE / (1 - self.SHARE) / 0.3
        assert expected == pytest.approx(0.667, abs=1e-3)
        assert np.mean(waits) == pytest.approx(expected, abs=4 * np.std(waits) / math.sqrt(len(waits)))

    def test_states_with_losses_of_their_own(self) -> None:
        model = gilbert_elliott(0.2, 1.0, good_loss=0.1, bad_loss=0.6)
        lost = np.isinf(radio(reception=model).delays_s(lists(100_000)))
        assert lost.mean() == pytest.approx(0.8 * 0.1 + 0.2 * 0.6, abs=0.02)

    def test_memory_of_a_constant_reception(self) -> None:
        """Held numbers: lost again after a loss with φ + (1 − φ) · .3."""
        one = radio(reception={"kind": "constant", "probability": 0.7},
                    memory={"reception": [{"share": 1.0, "correlation_s": 0.5}]})  # fmt: skip
        lost = np.isinf(one.delays_s(lists(100_000))[0])
        same = math.exp(-0.2)
        assert lost.mean() == pytest.approx(0.3, abs=0.02)
        assert lost[1:][lost[:-1]].mean() == pytest.approx(same + (1 - same) * 0.3, abs=0.01)

    def test_the_number_behind_is_uniform_wherever_one_begins(self) -> None:
        key = lists(50).air.draws.random_key  # type: ignore[union-attr]
        rng, runs = CounterRng(1, "log"), np.arange(3000)
        found = draw_dwelling_uniforms(rng, "p", key, runs, 0.7)
        assert stats.kstest(found[:, 20], "uniform").pvalue > 1e-3
        np.testing.assert_array_equal(
            draw_dwelling_uniforms(rng, "p", key.take(np.arange(30, 50)), runs, 0.7), found[:, 30:]
        )
        np.testing.assert_array_equal(
            draw_dwelling_uniforms(rng, "p", key.take(np.array([7])), runs[5:6], 0.7), found[5:6, 7:8]
        )


class TestOrderAndQueue:
    def test_no_list_overtakes_an_older_one(self) -> None:
        late = {"kind": "gamma", "mean_s": 0.3, "shape": 1}
        sent = lists(400, units=2)
        free, kept = (radio(latency=late, order=order).delays_s(sent)[0] + sent.sent_s for order in ("free", "kept"))
        for unit in range(2):
            mine = sent.unit_ix == unit
            assert (np.diff(free[mine]) < 0).any()
            np.testing.assert_allclose(kept[mine], np.maximum.accumulate(free[mine]), rtol=0, atol=1e-12)

    @given(st.data())
    def test_the_queue_is_that_of_an_event_loop(self, data: st.DataObject) -> None:
        count = data.draw(st.integers(1, 12))
        ready_ms = data.draw(st.lists(st.integers(0, 400), min_size=2 * count, max_size=2 * count))
        objects = data.draw(st.lists(st.integers(0, 60), min_size=2 * count, max_size=2 * count))
        made = data.draw(st.lists(st.booleans(), min_size=2 * count, max_size=2 * count))
        kbps = data.draw(st.sampled_from([50, 500, 6000]))
        sent = lists(count, units=2, objects=np.array(objects), made=np.array(made))
        sent = replace(sent, sent_s=sent.captured_s + np.array(ready_ms) / 1000)
        found = radio(channel={"kbps": kbps}).delays_s(sent)[0]
        for unit in range(2):
            free_at_s, waiting = 0.0, [k for k in range(2 * count) if sent.unit_ix[k] == unit and made[k]]
            while waiting:
                k = min(waiting, key=lambda k: (sent.sent_s[k], sent.captured_s[k]))
                waiting.remove(k)
                free_at_s = max(sent.sent_s[k], free_at_s) + 8 * (121 + 35 * objects[k]) / (1000 * kbps)
                assert found[k] == pytest.approx(free_at_s - sent.sent_s[k], abs=1e-9)


class Within(ReceptionModel):
    """One of a user's own, with a number that lasts."""

    radius_m: float

    def probability(self, path: RadioPath, noise: Any) -> Float:
        return np.where((path.distance_m < self.radius_m) & (noise("rain") < 0.5), 1.0, 0.0)


def test_a_reception_of_the_users_own() -> None:
    path = RadioPath(np.repeat([10.0, 90.0], 500), np.ones(1000))
    keys = {"kind": f"{__name__}:Within", "radius_m": 50}
    lasting = {"rain": [{"share": 1.0, "correlation_s": "always"}]}
    fresh, always = (
        np.isfinite(radio(reception=keys, memory=m).delays_s(lists(1000, path=path))[0]) for m in ({}, lasting)
    )
    assert 200 < fresh[:500].sum() < 300
    assert always[:500].sum() in (0, 500)
    assert not (fresh | always)[500:].any()


class Early(LatencyModel):
    """One of a user's own, of whose delays some are below 0."""

    def delays(self, uniform: Float) -> Float:
        return uniform - 0.5


def test_a_latency_of_the_users_own_below_0_is_refused() -> None:
    with pytest.raises(cr.InputError, match=r"delays.*expected seconds of 0 or more"):
        radio(latency={"kind": f"{__name__}:Early"}).delays_s(lists(100))


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"memory": {"flip": [{"share": 1, "correlation_s": 1}]}},
         r'no model of this link asks for noise "flip" \(they ask for latency, reception\)'),
        ({"reception": {"kind": "table", "distance_m": [0, 10], "probability": [1.0]}},
         r"probability: expected 2 rows \(distance_m\) of 1 values \(visible_share\), found 1 rows of \[1\]"),
        ({"reception": {"kind": "constant", "probability": 1.5}}, "less than or equal to 1"),
        ({"channel": {"kbps": 0}}, "greater than 0"),
        ({"latency": {"kind": "gama"}}, "kind: expected one of constant, gamma, lognormal"),
    ],
)  # fmt: skip
def test_what_is_no_link_is_refused(keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        radio(**keys)


class TestRecorded:
    def test_a_column_has_its_own_distribution(self, tmp_path: Path) -> None:
        values = np.random.default_rng(1).gamma(2.0, 0.03, 400)
        (tmp_path / "rtt.csv").write_text("n,latency_s\n" + "".join(f"{k},{v}\n" for k, v in enumerate(values)))
        model = latency({"kind": "recorded", "file": str(tmp_path / "rtt.csv"), "column": "latency_s"})
        uniform = (np.arange(4000) + 0.5) / 4000
        assert stats.ks_2samp(model.delays(uniform), values).statistic < 0.005
        np.testing.assert_array_equal(model.delays(np.arange(400) / 399), np.sort(values))

    def test_log_time_minus_stamp_of_a_topic(self) -> None:
        """Of the sample log, whose messages were logged when they were stamped."""
        file = str(Path(__file__).parents[2] / "logs" / "tc016d.mcap")
        model = latency({"kind": "recorded", "file": file, "topic": "ground_truth", "stamp": "timestamp"})
        assert set(model.delays(np.array([0.01, 0.5, 0.99])).tolist()) == {0.0}

    @pytest.mark.parametrize(
        ("text", "more", "said"),
        [
            ("latency_s\n-1\n-2\n0\n-3\n", {"column": "latency_s"}, "rtt.csv: column latency_s: 3 negative values"),
            ("latency_s\n", {"column": "latency_s"}, "rtt.csv: column latency_s: expected seconds, found none"),
            ("latency_s\nsoon\n", {"column": "latency_s"},
             "rtt.csv: column latency_s: expected seconds, found what is no number"),
            ("a,b\n1,2\n", {"column": "latency_s"},
             "rtt.csv: column latency_s: there is no such column; there are a, b"),
            ("a\n1\n", {}, "expected one of `column: <name>`"),
        ],
    )  # fmt: skip
    def test_a_file_that_is_none_is_refused(self, tmp_path: Path, text: str, more: dict[str, str], said: str) -> None:
        (tmp_path / "rtt.csv").write_text(text)
        with pytest.raises(ValidationError, match=said):
            latency({"kind": "recorded", "file": str(tmp_path / "rtt.csv"), **more})

    def test_it_is_relative_to_the_experiment_and_stays_where_it_is(self, tmp_path: Path) -> None:
        """A results folder names it relative to itself, and runs again."""
        (tmp_path / "rtt.csv").write_text("latency_s\n0.1\n0.3\n")
        log = Path(__file__).parents[2] / "logs" / "tc016d.mcap"
        plain = (log.parent / "tc016d.yaml").read_text().replace("tc016d.mcap", str(log))
        plain = re.sub(r"exact: true", "exact: false", plain.replace("runs: 500", "runs: 2"))
        text = re.sub(r"(?m)^configurations:.*\n(?:[ #].*\n|\n)*", CONFIGURATIONS, plain)
        (tmp_path / "plan.yaml").write_text(text)
        cr.run(tmp_path / "plan.yaml").save(tmp_path / "out")
        cr.run(tmp_path / "out" / "experiment.yaml").save(tmp_path / "again")
        tables = [(tmp_path / name / "summary.csv").read_bytes() for name in ("out", "again")]
        assert tables[0] == tables[1]


CONFIGURATIONS = """links: {v2x: {latency: {kind: recorded, file: rtt.csv, column: latency_s}}}
configurations:
  coop: {units: all, link: v2x}
show: null
"""
