"""Hostile inputs in every container that is read: MCAP files, OSI traces, folders of rosbag2. For `fuzz.py`."""

from __future__ import annotations

import random
import shutil
import struct
from pathlib import Path

from fuzzing.mcap_model import Message, Model, Sample, model_of
from fuzzing.mutators import BYTES, MUTATORS, flipped, hostile, protobuf_hit

TARGETS = ("mcap", "trace", "folder")
_TRACES, _FOLDERS = 0.1, 0.1  # shares of the inputs where no target is asked for
_KINDS = {b"osi3.GroundTruth": "gt", b"osi3.SensorView": "sv", b"osi3.SensorData": "sd"}
_LENGTHS = (0, 1, 3, 255, 65_535, 10**6, 2**28, 2**28 + 1, 2**31 - 1, 2**31, 2**32 - 1)
_NAMES = (
    "", ".", "..", "../input.mcap", "/etc/hosts", "/dev/zero", "metadata.yaml", "bag_0.db3", "bag_0.mcap.zstd",
    "sub/x.mcap", "bag_9.mcap", "x" * 5_000, '"\\ud800"', '"\\0"', '"a\\nb"', "[bag_0.mcap]", "{path: bag_0.mcap}",
    "*names", "&a bag_0.mcap", "null", "1", "!!binary aGk=",
)  # fmt: skip
_DESCRIPTIONS = (
    b"", b"\0" * 100, b"[" * 50_000, b"{a: " * 5_000, b"- 1\n", b"\xff\xfe", b"a: *b\n", b"a: b\n" * 20_000,
    b"&a [*a]\n", b"x" * (1 << 20), b"%YAML 9.9\n---\na\n", b"? ? ? :\n", b"rosbag2_bagfile_information:\n",
    b"rosbag2_bagfile_information: {relative_file_paths: {a: b}}\n", b"rosbag2_bagfile_information: [1]\n",
    b"rosbag2_bagfile_information: &a {relative_file_paths: [bag_0.mcap], files: *a}\n",
    b"rosbag2_bagfile_information: {files: [{path: bag_0.mcap}, {path: [1]}, 3]}\n",
)  # fmt: skip
Dice = random.Random


def put(samples: list[Sample], seed: str, folder: Path, target: str | None = None) -> tuple[Path, str]:
    """The input of a seed, written below `folder`: where it is, and what was done to it. `target`: None: any."""
    dice = Dice(f"{seed} container")
    pick = dice.random()
    if target is None:
        target = "trace" if pick < _TRACES else "folder" if pick < _TRACES + _FOLDERS else "mcap"
    if target == "trace":
        name, data, done = trace(samples, dice)
        path = folder / name
        path.write_bytes(data)
        return path, done
    if target == "folder":
        return bag(samples, dice, folder / "input")
    data, done = hostile(samples, seed)
    path = folder / "input.mcap"
    path.write_bytes(data)
    return path, done


def trace(samples: list[Sample], dice: Dice) -> tuple[str, bytes, str]:
    """The name of a trace, its content, and what was done to it."""
    sample = dice.choice([s for s in samples if any(schema.name in _KINDS for schema in s.schemas)])
    schema_of = {c.id: next((s.name for s in sample.schemas if s.id == c.schema), b"") for c in sample.channels}
    chosen = dice.choice([name for name in schema_of.values() if name in _KINDS])
    messages = [m.data for m in sample.messages if schema_of.get(m.channel) == chosen][: dice.choice((3, 10, 40))]
    done = [sample.name, "trace"]
    lengths = dict[int, int]()
    if messages and dice.random() < 0.5:
        done.append("messages")
        for k in dice.sample(range(len(messages)), dice.choice((1, 1, len(messages)))):
            hit = dice.choice((protobuf_hit, protobuf_hit, *BYTES))
            messages[k] = hit(messages[k], dice)
    if messages and dice.random() < 0.3:
        done.append("length")
        lengths[dice.randrange(len(messages))] = dice.choice(_LENGTHS)
    data = b"".join(struct.pack("<I", lengths.get(k, len(m))) + m for k, m in enumerate(messages))
    if dice.random() < 0.4:
        change = dice.choice(BYTES)
        done.append(change.__name__)
        data = change(data, dice)
    kind = dice.choice((_KINDS[chosen], _KINDS[chosen], *_KINDS.values(), "tu", "multi"))
    name = "input.osi" if dice.random() < 0.4 else f"20260102T030405Z_{kind}_3.8.0_6.33.1_{len(messages)}_name.osi"
    return name, data, " ".join(done)


def bag(samples: list[Sample], dice: Dice, folder: Path) -> tuple[Path, str]:
    """A folder of up to three files, of which one or the description is hit."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    sample = dice.choice(samples)
    done = [sample.name, "folder"]
    files = _split(model_of(sample, dice), dice.choice((1, 2, 3)))
    names = [f"bag_{k}.mcap" for k in range(len(files))]
    hit = dice.randrange(len(files)) if dice.random() < 0.7 else -1
    for k, (name, model) in enumerate(zip(names, files, strict=True)):
        if k == hit and model.pieces and dice.random() < 0.6:
            (change,) = dice.choices([m for m, _ in MUTATORS[:-1]], [w for _, w in MUTATORS[:-1]])
            change(model, sample, dice)
            done.append(change.__name__)
            hit = -1
        data = model.written()
        if k == hit:
            change_bytes = dice.choice((*BYTES, lambda data, dice: b""))
            data = change_bytes(data, dice)
            done.append(change_bytes.__name__)
        if k != hit or dice.random() < 0.9:
            (folder / name).write_bytes(data)
    pick = dice.random()
    if pick < 0.2:
        done.append("names")
        names.insert(dice.randrange(len(names) + 1), dice.choice((*_NAMES, *names)))
    text = _description(names, dice)
    if 0.2 <= pick < 0.3:
        done.append("description")
        text = dice.choice(_DESCRIPTIONS)
    elif 0.3 <= pick < 0.4:
        change_bytes = dice.choice((flipped, *BYTES))
        done.append(f"description {change_bytes.__name__}")
        text = change_bytes(text, dice)
    if pick < 0.98:
        (folder / "metadata.yaml").write_bytes(text)
    return folder, " ".join(done)


def _split(model: Model, number: int) -> list[Model]:
    """Its chunks in several files; with few chunks, the messages of each."""
    pieces = model.pieces
    if len(pieces) < number:
        whole = pieces[0]
        heads = [r for r in whole.records if not isinstance(r, Message)]
        messages = [r for piece in pieces for r in piece.records if isinstance(r, Message)]
        size = max(1, -(-len(messages) // number))
        parts = [messages[k : k + size] for k in range(0, max(len(messages), 1), size)]
        return [Model([type(whole)([*heads, *part], whole.compression)], indexed=model.indexed) for part in parts]
    size = -(-len(pieces) // number)
    return [Model(pieces[k : k + size], indexed=model.indexed) for k in range(0, len(pieces), size)]


def _description(names: list[str], dice: Dice) -> bytes:
    lines = ["rosbag2_bagfile_information:", "  version: 9", "  storage_identifier: mcap"]
    if dice.random() < 0.8:
        lines += ["  relative_file_paths:", *(f"    - {name}" for name in names)]
    lines += ["  files:", *(f"    - path: {name}\n      message_count: 3" for name in names)]
    lines += [f"  compression_format: {dice.choice(('', 'zstd'))}"]
    lines += [f"  compression_mode: {dice.choice(('', '', '', 'NONE', 'FILE', 'MESSAGE'))}"]
    return "\n".join(lines).encode()
