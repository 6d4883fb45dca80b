"""Running the converters in tests: what they write is read back, what they refuse leaves nothing behind."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from mcap.reader import make_reader
from osi3.osi_groundtruth_pb2 import GroundTruth

from copem_replay.cli import main as cli
from copem_replay.core.tracks import CLASSES
from copem_replay.io.recording import Recording, read_log
from copem_replay.results.outputs import CONVERSION

ROOT = Path(__file__).parents[2]


def convert(*words: str | Path) -> int:
    """Run `copem-replay convert` in this process; the exit code."""
    with patch.object(sys, "argv", ["copem-replay", "convert", *map(str, words)]):
        return cli._run_to_exit_code()


@dataclass(frozen=True)
class Converted:
    """A converted file: as the reader has it, as it is, and what was printed."""

    recording: Recording
    messages: list[GroundTruth]
    record: dict[str, str]
    printed: str

    @property
    def names(self) -> dict[str, str]:
        """Of the objects in the source, by id."""
        return dict(json.loads(self.record["ids"]))

    def id_of(self, name: str) -> str:
        (found,) = [ident for ident, known in self.names.items() if known == name]
        return found

    def class_of(self, ident: str) -> str:
        scene = self.recording.scene
        return CLASSES[scene.object_class[scene.object_number[ident]]]

    def moves(self, ident: str) -> bool:
        scene = self.recording.scene
        return bool(scene.moving[scene.object_number[ident]])

    def values(self, ident: str, *names: str) -> list[list[float]]:
        """Rows of an object, one list per instant."""
        truth, scene = self.recording.truth, self.recording.scene
        (track,) = np.flatnonzero(truth.object_ix == scene.object_number[ident])
        rows = slice(truth.start[track], truth.start[track + 1])
        return np.stack([getattr(truth, name)[0, rows] for name in names], axis=-1).tolist()

    @property
    def stamps_ns(self) -> list[int]:
        return [m.timestamp.seconds * 10**9 + m.timestamp.nanos for m in self.messages]


class Runner:
    """Converts into a folder of its own."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self.capsys = folder, capsys
        self.output = folder / "out" / "converted.mcap"

    def file(self, name: str, content: str | bytes) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def __call__(self, kind: str, source: Path, *options: str | Path) -> Converted:
        status = convert(kind, source, "--out", self.output, "--overwrite", *options)
        printed = self.capsys.readouterr()
        assert (status, printed.err) == (0, "")
        with self.output.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            messages = [GroundTruth.FromString(message.data) for *_, message in reader.iter_messages()]
            records = {record.name: record.metadata for record in reader.iter_metadata()}
        assert set(records) == {"net.asam.osi.trace", CONVERSION}
        assert list(self.output.parent.iterdir()) == [self.output]
        return Converted(read_log(self.output, name="converted"), messages, records[CONVERSION], printed.out)

    def refused(self, kind: str, source: Path, *options: str | Path) -> str:
        """Return the one line on stderr."""
        self.output.unlink(missing_ok=True)
        status = convert(kind, source, "--out", self.output, *options)
        printed = self.capsys.readouterr()
        assert (status, printed.out) == (2, "")
        assert not self.output.parent.exists() or not list(self.output.parent.iterdir())
        (line,) = printed.err.splitlines()
        return line


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Runner:
    return Runner(tmp_path, capsys)
