"""Tags of drives: from the experiment and from the recording, for slices and for conditions of PEMs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from mcap.writer import Writer

import copem_replay as cr
from copem_replay.core.errors import InputError
from copem_replay.io.open import open_log
from tests.helpers.experiments import TEXT, drive


def tagged(path: Path, *records: tuple[str, dict[str, str]], indexed: bool = True) -> Path:
    """The drive, written again with metadata records."""
    plain = drive(path.with_name(f"plain {path.name}"))
    from mcap.reader import make_reader

    with plain.open("rb") as source, path.open("wb") as target:
        writer = Writer(target, use_summary_offsets=indexed, use_statistics=indexed)
        writer.start()
        ids: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(ids[channel.topic], message.log_time, message.data, message.publish_time)
        for name, data in records:
            writer.add_metadata(name, data)
        writer.finish()
    return path


MEASURE = "measure: {onset: {kind: in_range, range_m: 60}, horizon_s: 2, by: [tags.weather]}"
BY_SITE = MEASURE.replace("weather]", "weather, 'log*tags.site']")
BLIND_IN_RAIN = "    - when: {tags: {weather: rain}}\n      detection: {kind: constant, probability: 0.0}\n"


def study(folder: Path, logs: str, *, pem: str = "", measure: str = MEASURE) -> Path:
    lines = [measure if line.startswith("measure:") else line for line in TEXT.splitlines()]
    text = "\n".join(lines).replace("logs: [drive.mcap]", logs).replace("  onboard:\n", f"  onboard:\n{pem}")
    path = folder / "experiment.yaml"
    path.write_text(text + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("indexed", [True, False])
def test_a_recording_has_the_tags_of_its_metadata(tmp_path: Path, indexed: bool) -> None:
    records = [("tags", {"weather": "rain", "site": "A"}), ("other", {"weather": "x"}), ("tags", {"site": "B"})]
    path = tagged(tmp_path / "wet.mcap", *records, indexed=indexed)
    assert open_log(path).tags == {"weather": "rain", "site": "B"}
    assert open_log(drive(tmp_path / "plain.mcap")).tags == {}


def test_the_tags_of_the_experiment_come_over_those_of_the_recording(tmp_path: Path) -> None:
    tagged(tmp_path / "a.mcap", ("tags", {"weather": "rain", "site": "A"}))
    drive(tmp_path / "b.mcap")
    logs = "tags: {country: DE, lanes: 2}\nlogs: [{file: a.mcap, tags: {site: B, lanes: 3}}, {file: b.mcap}]"
    result = cr.run(study(tmp_path, logs, measure=BY_SITE))
    assert {log.name: dict(log.tags) for log in result.provenance.logs} == {
        "a": {"weather": "rain", "site": "B", "country": "DE", "lanes": "3"},
        "b": {"country": "DE", "lanes": "2"},
    }
    assert result.summary_by is not None
    groups = result.summary_by[["by", "group"]].drop_duplicates().itertuples(index=False)
    assert [tuple(group) for group in groups] == [
        ("tags.weather", "rain"), ("tags.weather", "(no tag)"),
        ("log*tags.site", "a, B"), ("log*tags.site", "b, (no tag)"),
    ]  # fmt: skip
    saved = cr.load_results(result.save(tmp_path / "out"))
    assert [log["tags"] for log in json.loads((tmp_path / "out/provenance.json").read_text())["logs"]] == [
        dict(log.tags) for log in saved.provenance.logs
    ]
    again = cr.run(tmp_path / "out/experiment.yaml").save(tmp_path / "again")
    for name in ("summary_by.csv", "tally.parquet"):
        assert (again / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


def test_a_couple_of_a_pem_applies_where_the_drive_has_its_tags(tmp_path: Path) -> None:
    drive(tmp_path / "wet.mcap")
    drive(tmp_path / "dry.mcap")
    logs = "logs: [{file: wet.mcap, tags: {weather: rain}}, {file: dry.mcap, tags: {weather: dry}}]"

    def shares(pieces: Path, logs: str) -> dict[str, float]:
        result = cr.run(study(tmp_path, logs, pem=BLIND_IN_RAIN), pieces=pieces)
        assert result.summary_by is not None
        rows: Any = result.summary_by[result.summary_by["by"] == "tags.weather"]
        of = rows[rows["configuration"] == "PEM"].set_index("group")["detected_share"]
        return {str(group): float(share) for group, share in of.items()}

    assert shares(tmp_path / "pieces", logs) == {"dry": 1.0, "rain": 0.0}
    # Parts that are kept are those of the tags.
    swapped = logs.replace("rain", "fog").replace("dry}", "rain}")
    assert shares(tmp_path / "pieces", swapped) == {"fog": 1.0, "rain": 0.0}


@pytest.mark.parametrize(
    ("logs", "pem", "said"),
    [
        ("logs: [drive.mcap]", "", "measure.by[0]: no log has the tag 'weather'; `logs: [{file: …, tags: {…}}]` gives"),
        ("logs: [{file: drive.mcap, tags: {wether: rain, site: A}}]", "",
         "measure.by[0]: no log has the tag 'weather'; did you mean wether?; there are site, wether"),
        ("logs: [{file: drive.mcap, tags: {site: A}}]", BLIND_IN_RAIN,
         "pems.onboard[0].when.tags: no log has the tag 'weather'"),
        ("logs: [{file: drive.mcap, tags: {weather: [rain]}}]", "", "logs[0].tags.weather: expected text"),
        ("logs: [{file: drive.mcap, tags: rain}]", "", "logs[0].tags: expected"),
        ("logs: [{file: drive.mcap, tags: {weather: ''}}]", "", "logs[0].tags.weather"),
    ],
)  # fmt: skip
def test_a_tag_that_no_log_has_is_refused(tmp_path: Path, logs: str, pem: str, said: str) -> None:
    drive(tmp_path / "drive.mcap")
    with pytest.raises(InputError) as error:
        cr.run(study(tmp_path, logs, pem=pem))
    assert said in str(error.value)


def test_slices_need_no_replay(tmp_path: Path) -> None:
    drive(tmp_path / "a.mcap")
    drive(tmp_path / "b.mcap", first=11)
    logs = "logs: [{file: a.mcap, ego: 1, tags: {weather: rain}}, {file: b.mcap, ego: 11, tags: {weather: dry}}]"
    folder = cr.run(study(tmp_path, logs)).save(tmp_path / "out")
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).unlink()
    from copem_replay.results.slices import summarise_slices

    results = cr.load_results(folder)
    found = summarise_slices(results, ["tags.weather"])
    assert found is not None
    assert results.summary_by is not None
    expected = results.summary_by[results.summary_by["by"] == "tags.weather"].reset_index(drop=True)
    for name in ("group", "configuration", "n", "detected_share", "position_rmse_m", "false_positives_per_min"):
        pd.testing.assert_series_equal(found[name], expected[name], check_dtype=False)
    for entry, said in (
        ("tags.site", "--by: tags.site: expected a tag that some log has, found none; tags are weather"),
        ("range_at_onset", "--by: range_at_onset: expected an onset that is no range, found in_range: what comes "
                           "nearer is at 60 m, and all else began nearer"),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            summarise_slices(results, [entry])
        assert str(error.value).startswith(said)
