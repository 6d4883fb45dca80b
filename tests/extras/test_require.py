"""`require`: for which values of a key a criterion holds, against every value replayed by itself, and by hand."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

import copem_replay as cr
from copem_replay.extras.require.api import _search_grid
from copem_replay.extras.require.outputs import tabulate_requirement, tell_requirement
from tests.helpers.experiments import TEXT, drive
from tests.system.test_cli import Call, call, here

__all__ = ["call", "here"]

P, LATENCY = "pems.onboard[0].detection.probability", "configurations.coPEM.latency_s"
HERE = {"population": "these_logs"}
LEVELS = {"not met": 0, "undecided": 1, "met": 2}
SOON = {"metric": "ttd_rmst_s", "at_most": 0.1, "configurations": ["PEM"], **HERE}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("require") / "drive.mcap")


def experiment(runs: int = 40, exact: bool = False, **more: Any) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(TEXT.replace("{on: ego", '{"on": ego'))
    data["measure"] |= {"exact": exact, "accuracy": False}
    return {key: of for key, of in data.items() if key != "logs"} | {"runs": runs} | more


def find(recording: Path, criterion: dict[str, Any], *free: str, of: Any = None, **how: Any) -> Any:
    return cr.require(of or experiment(), recording, criterion="it", free=free, criteria={"it": criterion}, **how)


def told(needed: Any) -> list[str]:
    return list(tell_requirement(needed))


def words(needed: Any) -> Any:
    """0: not met, 1: undecided, 2: met, at every value."""
    return (needed.levels + 1) // 2


# Against every value by itself: the whole experiment is replayed, and judged.


def judge_one(recording: Path, data: dict[str, Any], criterion: dict[str, Any], at: dict[str, float]) -> int:
    data = experiment(data["runs"], data["measure"]["exact"])
    for key, value in at.items():
        if key == P:
            data["pems"]["onboard"][0]["detection"]["probability"] = value
        else:
            data["configurations"]["coPEM"]["latency_s"] = value
    (verdict,) = cr.judge(cr.run(data, recording), {"it": criterion}).all
    return LEVELS[verdict.verdict]


@pytest.mark.parametrize(
    ("criterion", "key", "span", "exact"),
    [
        (SOON, P, (0.3, 0.8, 0.05), False),
        (SOON | {"metric": "ttd_rmst_s_exact"}, P, (0.3, 0.8, 0.05), True),
        (SOON | {"configurations": ["coPEM"], "against": "PEM", "at_most": 0.0}, LATENCY, (0.0, 0.5, 0.05), False),
        ({"metric": "detected_share", "at_least": 0.99, "configurations": ["PEM"], **HERE}, P, (0.1, 0.6, 0.05), False),
        (SOON | {"metric": "ttd_p95_s", "at_most": 0.5}, P, (0.15, 0.65, 0.05), False),
    ],
)
def test_it_is_what_every_value_gives_by_itself(
    recording: Path, criterion: dict[str, Any], key: str, span: tuple[float, float, float], exact: bool
) -> None:
    data = experiment(exact=exact)
    needed = find(recording, criterion, f"{key}={span[0]}:{span[1]}:{span[2]}", of=data)
    (free,) = needed.keys
    assert free.values == pytest.approx(np.arange(span[0], span[1] + 1e-9, span[2]))
    expected = [judge_one(recording, data, criterion, {key: value}) for value in free.values]
    assert words(needed).tolist() == expected
    assert len(set(expected)) > 1
    assert len(needed.trials) < len(free.values) or needed.levels.size <= 9


def test_a_front_is_what_every_pair_gives_by_itself(recording: Path) -> None:
    data = experiment(exact=True)
    criterion = {"metric": "ttd_rmst_s_exact", "at_most": 0.35, "configurations": ["coPEM"], **HERE}
    needed = find(recording, criterion, f"{LATENCY}=0:0.5:0.1", f"{P}=0.1:0.8:0.1", of=data)
    pairs = product(*(key.values for key in needed.keys))
    expected = [judge_one(recording, data, criterion, {LATENCY: late, P: p}) for late, p in pairs]
    assert words(needed).ravel().tolist() == expected
    assert needed.monotone
    late, p = needed.required
    at = [of.index(value) for of, value in zip((key.values for key in needed.keys), (late, p), strict=True)]
    assert needed.levels[at[0], at[1]] == 3
    assert needed.levels[at[0] + 1, at[1]] < 3
    assert needed.levels[at[0], at[1] - 1] < 3
    head, *_rows = tabulate_requirement(needed)
    assert head.split() == ["latency_s", "probability:", "holds", "from", "not", "up", "to"]
    assert "which passes, of the front." in told(needed)[-1]


def test_bisection_finds_every_change_that_the_first_values_show() -> None:
    line = np.repeat([3, 2, 1, 0], [31, 7, 40, 22])
    asked: list[int] = []

    def level(index: tuple[int, ...]) -> int:
        asked.append(index[0])
        return int(line[index])

    assert _search_grid((100,), level).tolist() == line.tolist()
    assert len(asked) == len(set(asked)) < 30


@pytest.mark.parametrize("shape", [(20, 20), (7, 40), (2, 3), (1001, 2)])
def test_a_front_that_is_monotone_is_found_whole(shape: tuple[int, int]) -> None:
    x, y = np.indices(shape)
    for slope in (0.3, 1.0, 4.0):
        levels = np.digitize(y / shape[1] - slope * (x / shape[0]) ** 2, [-0.5, 0.0, 0.3])
        asked: list[Any] = []
        found = _search_grid(shape, lambda index: asked.append(index) or int(levels[index]))  # noqa: B023
        assert found.tolist() == levels.tolist()
        assert len(asked) == len(set(asked)) <= levels.size


# By hand.


def test_the_smallest_probability_in_closed_form(recording: Path) -> None:
    """10 lists a second, each with probability p: the mean of min(time, 2 s) is .1 Σ (1 − p)^k, k = 1 … 20."""
    needed = find(recording, SOON, P, of=experiment(exact=True))
    assert needed.criterion.metric == "ttd_rmst_s_exact"
    assert needed.required == (0.5,)
    assert needed.wants == ["smallest"]
    assert told(needed)[0] == "It holds from probability 0.5 on; it does not hold up to 0.495."
    rows = needed.table.set_index(P)["estimate"]
    assert rows[0.5] == pytest.approx(0.1 * (1 - 0.5**20))
    assert rows[0.495] == pytest.approx(0.1 * sum(0.505**k for k in range(1, 21)))


def test_the_latency_of_the_paper_at_which_units_do_not_help_any_more() -> None:
    data = yaml.safe_load(
        (Path(__file__).parents[2] / "logs/tc016d.yaml").read_text().replace("{on: ego", '{"on": ego')
    )
    data = {key: of for key, of in data.items() if key != "logs"} | {"runs": 100}
    criterion = {"metric": "ttd_rmst_s", "against": "PEM", "at_most": 0, "configurations": ["coPEM:0.5s"], **HERE}
    log = Path(__file__).parents[2] / "logs/tc016d.mcap"
    needed = find(log, criterion, "configurations.coPEM:0.5s.latency_s=0:1.6:0.1", of=data)
    assert 0.7 <= needed.required[0] <= 0.8
    assert [word for word, _ in needed.segments] in (["met", "not met"], ["met", "undecided", "not met"])


def test_three_answers_and_what_would_decide(recording: Path) -> None:
    needed = find(recording, SOON, f"{P}=0.2:0.9:0.02")
    assert [word for word, _ in needed.segments] == ["not met", "undecided", "met"]
    ends, turn, *undecided, last = told(needed)
    held, refuted = needed.segments[2][1][0].values[0], needed.segments[0][1][-1].values[0]
    expected = f"It holds from probability {held:g} on; it does not hold up to {refuted:g}; it is undecided between."
    assert ends == expected
    assert refuted < 0.5 < held
    assert turn.startswith("The figure itself crosses its bound between 0.")
    assert undecided
    assert all("runs like these would decide (40 now)" in line for line in undecided)
    assert last == f"required.yaml has probability {held:g}, the smallest value that passes."


def test_what_is_not_refuted_passes_where_it_is_undecided(recording: Path) -> None:
    free = f"{P}=0.2:0.9:0.02"
    shown = find(recording, SOON, free)
    needed = find(recording, SOON | {"passes_when": "not_refuted"}, free)
    assert needed.required[0] == needed.segments[1][1][0].values[0] < shown.required[0]


def test_it_holds_everywhere_or_nowhere(recording: Path) -> None:
    everywhere = find(recording, SOON | {"at_most": 2}, f"{P}=0.2:0.9")
    assert told(everywhere)[0] == "It holds at every value, probability 0.2 to 0.9."
    assert everywhere.required == (0.2,)  # of a probability the smallest is wanted
    assert len(everywhere.trials) == 9
    nowhere = find(recording, SOON | {"at_most": -1}, f"{P}=0.2:0.9")
    assert told(nowhere) == [
        "It does not hold at every value, probability 0.2 to 0.9.",
        "No value that was tried passes.",
    ]
    assert nowhere.required is None
    assert nowhere.experiment is None


def test_a_figure_that_does_not_depend_on_the_key(recording: Path) -> None:
    needed = find(recording, SOON | {"at_most": 2}, "pems.onboard[0].error.covariance_m2[0][0]")
    assert told(needed)[0].endswith("covariance_m2[0][0] 0 to 10: ttd_rmst_s is the same throughout.")
    assert needed.required == (10,)  # of an error the largest


def test_a_verdict_that_changes_back_is_told_and_does_not_mislead(recording: Path) -> None:
    """A mast that looks 60° to each side sees the car ahead while it is turned by less."""
    of = experiment(runs=30)
    of["pems"]["onboard"] = [
        {"when": {"azimuth_deg": [-60, 60]}, "detection": {"kind": "constant", "probability": 1.0}},
    ]
    of["configurations"] |= {"mast": {"units": ["mast"]}}
    criterion = {"metric": "detected_share", "at_least": 0.5, "configurations": ["mast"], **HERE}
    turned = {want: find(recording, criterion, "units.mast.yaw_deg=-180:180:5", of=of, want=[want])
              for want in ("largest", "smallest")}  # fmt: skip
    needed = turned["largest"]
    assert [word for word, _ in needed.segments] == ["not met", "met", "not met"]
    assert not needed.monotone
    assert any(line.startswith("It is not monotone: the verdict changes back") for line in told(needed))
    assert turned["largest"].required[0] - turned["smallest"].required[0] == pytest.approx(120, abs=15)
    assert told(needed)[0].startswith(f"It holds up to yaw_deg {needed.required[0]:g}; it does not hold from ")


def test_nothing_measured_says_why(recording: Path) -> None:
    """A single object tells nothing of such traffic."""
    needed = find(recording, SOON | {"population": "such_traffic"}, f"{P}=0.2:0.9")
    first, why, last = told(needed)
    assert first.startswith("It is not measured at every value")
    assert "one object tells nothing of other traffic" in why
    assert last == "No value that was tried passes."


# What is refused.


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ("pems.onbord[0].detection.probability", r"did you mean pems.onboard\[0\].detection.probability\?"),
        ("pem.onboard[0].detection.probability", r"did you mean pems.onboard\[0\].detection.probability\?"),
        ("pems.onboard[0].detection.probabilty", r"did you mean pems.onboard\[0\].detection.probability\?"),
        ("pems.onboard[3].detection.probability", r"did you mean pems.onboard\[0\].detection.probability\?"),
        ("pems.onboard[0].detection", r"did you mean pems.onboard\[0\].detection.probability\?"),
        ("configurations.coPEM.latencys", r"did you mean configurations.coPEM.latency_s\?"),
        ("measure.horizon_s", "expected the key of a number below pems, units, links, configurations; "),
        ("seed", "expected the key of a number below pems, units, links, configurations; such as pems.onboard"),
        ("", "expected the key of a number below pems, units, links, configurations; such as pems.onboard"),
        (f"{P}=0:1:much", "expected numbers, KEY=FROM:TO:STEP, found =0:1:much"),
        (f"{P}=1:0", "expected FROM below TO"),
        (f"{P}=0:1:1e-9", "a step with which there are 2 to 10,000 values"),
        (f"{P}=0:2", "with probability 2: .*expected at most 1, found 2.0"),
        ("units.mast.yaw_deg", "nothing says between which values it is sought; say units.mast.yaw_deg=FROM:TO"),
        (LATENCY, "expected a key used by PEM, which the criterion is about, found one of coPEM"),
        ("units.mast.height_m=2:9", "expected a key used by PEM, which the criterion is about, found one of coPEM"),
    ],
)
def test_a_key_that_is_none_of_the_criterion_is_refused(recording: Path, free: str, message: str) -> None:
    with pytest.raises(cr.InputError, match=message) as error:
        find(recording, SOON, free)
    assert str(error.value).count("\n") == 0


def test_what_else_is_refused(recording: Path) -> None:
    with pytest.raises(cr.InputError, match="no criterion is named 'itt'; did you mean it"):
        cr.require(experiment(), recording, criterion="itt", free=[P], criteria={"it": SOON})
    with pytest.raises(cr.InputError, match="expected `against` a configuration, found results of before"):
        find(recording, SOON | {"against": "before"}, P)
    with pytest.raises(cr.InputError, match="expected one key or two, found 3"):
        find(recording, SOON, P, P, P)
    with pytest.raises(cr.InputError, match="want: expected largest or smallest of each key, found most"):
        find(recording, SOON, P, want=["most"])


@pytest.mark.parametrize("path", ["pems.onboard.couples[0].detection.probability", P])
def test_both_forms_of_a_pem_are_one_key(recording: Path, path: str) -> None:
    of = experiment()
    of["pems"]["onboard"] = {
        "couples": of["pems"]["onboard"],
        "memory": {"detection": [{"share": 0.5, "correlation_s": 1}]},
    }
    for data in (experiment(), of):
        (key,) = find(recording, SOON, f"{path}=0.3:0.6:0.1", of=data).keys
        assert key.about == "probability"


# What is written.


def test_the_same_bytes_on_any_number_of_workers(recording: Path, tmp_path: Path) -> None:
    for jobs in (1, 3):
        cr.write_requirement(find(recording, SOON, f"{P}=0.2:0.9:0.1", jobs=jobs), tmp_path / str(jobs))
    names = [path.name for path in sorted((tmp_path / "1").iterdir())]
    assert names == ["require.csv", "require.png", "required.yaml"]
    for name in names:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "3" / name).read_bytes()


def test_the_experiment_that_is_written_keeps_the_criterion(recording: Path, tmp_path: Path) -> None:
    needed = find(recording, SOON, P, of=experiment(exact=True))
    cr.write_requirement(needed, tmp_path / "needed")
    result = cr.run(tmp_path / "needed/required.yaml")
    (verdict,) = cr.judge(result).all
    assert (verdict.criterion, verdict.verdict, verdict.metric) == ("it", "met", "ttd_rmst_s_exact")
    assert list(result.experiment.configurations) == ["GT", "PEM", "coPEM"]
    written = pd.read_csv(tmp_path / "needed/require.csv")
    assert written[P].is_monotonic_increasing
    assert written.loc[written[P] == 0.5, "verdict"].tolist() == ["met"]


def test_files_of_the_user_are_not_replaced_and_old_answers_go(recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "needed"
    cr.write_requirement(find(recording, SOON, f"{P}=0.2:0.9:0.1"), folder)
    cr.write_requirement(find(recording, SOON | {"at_most": -1}, f"{P}=0.2:0.9:0.1"), folder)
    assert [path.name for path in sorted(folder.iterdir())] == ["require.csv", "require.png"]
    (folder / "required.yaml").write_text("version: 1\n")
    with pytest.raises(cr.OutputError, match=r"required.yaml: expected another name, found a file of YAML"):
        cr.write_requirement(find(recording, SOON, f"{P}=0.2:0.9:0.1"), folder)


# The command.


def test_the_command_and_its_exit_codes(call: Call, here: Path) -> None:
    (here / "e.yaml").write_text(
        TEXT
        + "criteria:\n  soon: {metric: ttd_rmst_s, at_most: 0.4, configurations: [coPEM], population: these_logs}\n"
        "  never: {metric: ttd_rmst_s, at_most: -1, configurations: [coPEM], population: these_logs}\n"
    )
    words = ["--free", f"{LATENCY}=0:1.5:0.1"]
    done = call("require", "e.yaml", "--criterion", "soon", *words)
    lines = done.out.splitlines()
    assert done.code == 0
    assert lines[:2] == ["soon: known after (mean) ≤ 0.4 s, coPEM", f"{LATENCY}: 0 to 1.5 by 0.1"]
    assert "require.csv, require.png, required.yaml in out/e_require" in lines
    assert lines[-1].startswith("required.yaml has latency_s 0.")
    assert call("run", "out/e_require/required.yaml").code == 1  # `never` does not pass
    assert call("require", "e.yaml", "--criterion", "never", *words, "--out", "out/never").code == 1
    refused = call("require", "e.yaml", "--criterion", "son", *words)
    assert refused == (2, "", ["no criterion is named 'son'; did you mean soon?"])
