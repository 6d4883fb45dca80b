"""`copem-replay why`: what it prints and writes, and lines of what is wrong."""

from __future__ import annotations

import html
import re
import sys
from pathlib import Path

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.errors import InputError
from tests.helpers.compare_folders import flip, places
from tests.helpers.experiments import changed, drive

TEXT = changed("show: null")
AGAIN = "run `copem-replay why` on the folder again"


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """Calls the command on the drive: its exit code, what it prints, what it says on stderr."""
    monkeypatch.chdir(tmp_path)
    drive(Path("drive.mcap"))
    Path("e.yaml").write_text(TEXT)

    def called(*words: str) -> tuple[int, list[str], list[str]]:
        monkeypatch.setattr(sys, "argv", ["copem-replay", "why", *words])
        code = cli._run_to_exit_code()
        said = capsys.readouterr()
        return code, said.out.splitlines(), said.err.splitlines()

    return called


def test_all_parts_of_all_configurations_with_units(call) -> None:  # type: ignore[no-untyped-def]
    code, said, notes = call("e.yaml", "--explain")
    assert code == 0
    assert said[-1] == "why.csv, units.csv, triage.csv, late_episodes.csv, sensitivity.csv in out/e_why"
    causes = pd.read_csv("out/e_why/why.csv")
    assert list(dict.fromkeys(causes["configuration"])) == ["PEM", "coPEM"]
    late = causes[causes["configuration"] == "coPEM"].set_index("cause")
    assert late["added_s"]["latency"] == pytest.approx(0.5)
    assert pd.read_csv("out/e_why/units.csv")["unit"].tolist() == ["mast"]
    assert any("PEM: expected a unit beside the ego's, found ego alone" in note for note in notes)
    head = next(line for line in said if line.startswith("coPEM: objects are unknown"))
    assert head == f"coPEM: objects are unknown for {late['added_s'].sum():.2f} s in the mean"


def test_the_screen_has_the_seconds_of_the_tables(call) -> None:  # type: ignore[no-untyped-def]
    """A cause that adds nothing has no column; whoever is unknown the shortest comes first."""
    _, said, _ = call("e.yaml")
    causes = (
        pd.read_csv("out/e_why/why.csv").pivot(index="configuration", columns="cause", values="added_s").fillna(0.0)
    )
    assert len(said) <= 24
    assert max(map(len, said)) <= 120
    head, *rows = [re.split(r" {2,}", line.strip()) for line in said[: said.index("") - 1]]
    assert said[len(rows) + 1].startswith("Mean seconds that an object is unknown, to its end")
    shown = {"missed in sight": "missed", "latency": "latency", "hidden": "hidden", "out of view": "range"}
    assert head[0] == "unknown"
    assert {shown[word] for word in head[1:]} == set(causes.columns[(causes.abs() >= 0.005).any()])
    assert [row[0] for row in rows] == list(causes.sum(axis=1).sort_values().index)
    for name, total, *cells in rows:
        assert float(total) == pytest.approx(causes.loc[name].sum(), abs=0.00501)
        for word, cell in zip(head[1:], cells, strict=True):
            assert float(cell.replace("–", "0")) == pytest.approx(causes.loc[name, shown[word]], abs=0.00501)
    spared = pd.read_csv("out/e_why/units.csv").set_index(["configuration", "unit"])["share_s"]["coPEM", "mast"]
    assert f"mast saves {spared:.2f} s in coPEM." in said
    assert said[-1].endswith("; every figure: --explain")


def test_a_configuration_that_only_some_logs_have_is_explained_by_these(call) -> None:  # type: ignore[no-untyped-def]
    drive(Path("second.mcap"))
    logs = "logs: [{file: second.mcap, units: {mast: null}}, drive.mcap]"
    text = TEXT.replace("PEM: {units: [ego]}", "PEM: {units: [mast]}")
    Path("e.yaml").write_text(text)
    Path("two.yaml").write_text(text.replace("logs: [drive.mcap]", logs))
    code, _, notes = call("two.yaml", "--causes", "--configuration", "PEM", "--out", "two")
    assert code == 0
    assert "note: PEM: of drive alone; other logs lack its units" in notes
    assert call("e.yaml", "--causes", "--configuration", "PEM", "--out", "one")[0] == 0
    assert Path("two/why.csv").read_bytes() == Path("one/why.csv").read_bytes()


def test_only_what_is_asked_for_is_written(call) -> None:  # type: ignore[no-untyped-def]
    code, said, _ = call("e.yaml", "--causes", "--configuration", "PEM", "--out", "there")
    assert code == 0
    assert [path.name for path in Path("there").iterdir()] == ["why.csv"]
    assert said[-1] == "why.csv in there"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--configuration", "coPEN"), "no configuration is named 'coPEN'; did you mean coPEM?"),
        (("--configuration", "GT"), "configuration GT: is the truth, which is never late; choose one with units"),
        (("--configuration", "coPEM", "--units", "--unit", "mats"),
         "no unit is named 'mats'; did you mean mast?"),
        (("--unit", "mats"), "no unit is named 'mats'; did you mean mast?"),
        (("--out", "drive.mcap"), "drive.mcap: expected another name, found a recording"),
    ],
)  # fmt: skip
def test_wrong_input_is_a_line(call, words: tuple[str, ...], line: str) -> None:  # type: ignore[no-untyped-def]
    code, _, problems = call("e.yaml", *words)
    assert (code, problems[-1]) == (2, line)
    assert not Path("out").exists()


@pytest.fixture
def results(call) -> Path:  # type: ignore[no-untyped-def]
    """A results folder of the drive, explained; with 1.5 s of latency, so that an object is late."""
    text = Path("e.yaml").read_text()
    Path("e.yaml").write_text(text.replace("latency_s: 0.5", "latency_s: 1.5"))
    cr.run("e.yaml", jobs=1).save("results")
    code, said, _ = call("results", "--causes", "--units", "--triage")
    assert code == 0
    assert said[-1] == "why.csv, units.csv, triage.csv, late_episodes.csv in results/why"
    return Path("results")


def test_the_report_of_a_folder_shows_what_why_put_there(results: Path) -> None:
    """The table has the seconds of `why.csv`, rounded; stories say why, of the runs' mean."""
    page = html.unescape(cr.write_report(results).read_text(encoding="utf-8"))
    section = page[page.index('<section id="why">') :]
    section = section[: section.index("</section>")]
    causes = pd.read_csv(results / "why/why.csv")
    rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", section)]
    head = rows[0]
    last = next(k for k, row in enumerate(rows) if row[0] == "all")
    table = {row[0]: dict(zip(head, row, strict=True)) for row in rows[1 : last + 1]}
    assert head == ["cause", "PEM", "coPEM"]
    assert table["latency"] == {"cause": "latency", "PEM": "", "coPEM": "1.50"}
    for name, of in causes.groupby("configuration"):
        assert float(table["all"][str(name)]) == pytest.approx(of["added_s"].sum(), abs=0.006)
    late = pd.read_csv(results / "why/late_episodes.csv", dtype={"object_id": str})
    told = set(late["configuration"] + " " + late["words"])
    stories = re.findall(r"Mean over all runs: (.*?)\.</p>", page)
    assert stories
    for line in stories:
        assert all(part in told or part.endswith(" is not late") for part in line.split("; "))


def test_without_why_the_report_has_no_such_section(call) -> None:  # type: ignore[no-untyped-def]
    cr.run("e.yaml", jobs=1).save("results")
    page = cr.write_report("results").read_text(encoding="utf-8")
    assert 'id="why"' not in page
    assert "Mean over all runs" not in page


@pytest.mark.parametrize("name", ["why.csv", "units.csv", "triage.csv", "late_episodes.csv"])
def test_a_flipped_bit_of_a_table_is_refused(results: Path, name: str) -> None:
    file = results / "why" / name
    content = file.read_bytes()
    for bit in places(file, 5):
        flip(file, bit)
        with pytest.raises(InputError) as refused:
            cr.write_report(results)
        line = f"{file}: expected the file that was written, SHA-256 .*; put it back, or {AGAIN}"
        assert re.fullmatch(line, str(refused.value))
        file.write_bytes(content)
    cr.write_report(results)


def test_a_flipped_bit_of_the_list_of_seals_never_shows_other_tables(results: Path) -> None:
    made = results / "made.jsonl"
    right, content = cr.write_report(results).read_bytes(), made.read_bytes()
    refused = 0
    for bit in places(made, 25):
        flip(made, bit)
        try:
            assert cr.write_report(results).read_bytes() == right
        except InputError as error:
            refused += str(error).startswith(f"{results}/why/")
        made.write_bytes(content)
    assert refused > 10


def test_a_table_that_why_did_not_write_is_refused(results: Path) -> None:
    (results / "why/sensitivity.csv").write_text("variation,configuration,run,unknown_s\n")
    with pytest.raises(InputError) as refused:
        cr.write_report(results)
    assert str(refused.value) == (
        f"{results}/why/sensitivity.csv: expected no such file among these results, found one; give it another name, "
        f"or {AGAIN}"
    )


def test_they_go_with_the_results(results: Path) -> None:
    cr.run("e.yaml", jobs=1).save(results, overwrite=True)
    assert not (results / "why").exists() or not list((results / "why").iterdir())


def test_what_does_not_apply_is_left_out_unless_it_is_asked_for(call) -> None:  # type: ignore[no-untyped-def]
    """The ego alone has no other unit, and one configuration no order; its time is told as the PEMs vary."""
    code, said, notes = call("e.yaml", "--configuration", "PEM")
    assert code == 0
    assert notes[-1] == "note: no units: configuration PEM: expected a unit beside the ego's, found ego alone"
    assert any(line.startswith("As the PEMs vary it is unknown for 0.") for line in said)
    assert not any("pairs" in line for line in said)
    code, _, problems = call("e.yaml", "--configuration", "PEM", "--units")
    assert (code, problems[-1]) == (2, "configuration PEM: expected a unit beside the ego's, found ego alone")


def test_what_nobody_can_know_is_counted_apart(call) -> None:  # type: ignore[no-untyped-def]
    """2 s from the onset to the end, and no list arrives within 2.5 s."""
    Path("e.yaml").write_text(TEXT.replace("latency_s: 0.5", "latency_s: 2.5"))
    code, said, _ = call("e.yaml", "--triage", "--configuration", "coPEM")
    assert code == 0
    late = pd.read_csv("out/e_why/late_episodes.csv")
    hopeless = late[late["hopeless_share"] == 1]
    assert len(hopeless) == 1
    lost_s = hopeless["unknown_s"].sum()
    assert f"coPEM: 1 episode, {lost_s:.1f} s, end before any list can tell of them: in no group" in said
