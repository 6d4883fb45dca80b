"""A recorded latency: what lists took by a file, by a column of a CSV or by an MCAP topic's log times and stamps."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, field_validator, model_validator

from copem_replay.communication.latency import LatencyModel
from copem_replay.core.components import at_key
from copem_replay.core.errors import InputError
from copem_replay.core.text import counted
from copem_replay.core.tracks import Float
from copem_replay.io.encodings.columns import take_apart
from copem_replay.io.encodings.definition import definition_of
from copem_replay.io.encodings.raw_values import DefinitionError
from copem_replay.io.messages import gathered
from copem_replay.io.open import open_log
from copem_replay.io.schemas.timestamps import nanoseconds, stamps_in

Name = Annotated[str, Field(min_length=1)]


class RecordedLatency(LatencyModel):
    """Recorded latencies: `column` of a CSV, in seconds, or log time − `stamp` of the messages on an MCAP's `topic`.

    `file` is relative to the experiment file. Quantiles are interpolated linearly between the values.
    """

    kind: Literal["recorded"] = "recorded"
    file: Name
    column: Name | None = None
    topic: Name | None = None
    stamp: Name = "header.stamp"
    _sorted_s: tuple[float, ...] = PrivateAttr(())

    @field_validator("file")
    @classmethod
    def _beside(cls, file: str, info: ValidationInfo) -> str:
        folder = (info.context or {}).get("folder")
        return file if folder is None else str(Path(folder) / file)

    @model_validator(mode="after")
    def _read(self) -> Self:
        if (self.column is None) == (self.topic is None):
            raise ValueError("expected one of `column: <name>` (of a CSV) and `topic: <name>` (of an MCAP)")
        where = f"{Path(self.file).name}: {f'column {self.column}' if self.column else f'topic {self.topic}'}"
        try:
            found = _of_column(Path(self.file), self.column) if self.column else self._of_topic(str(self.topic))
        except (OSError, UnicodeDecodeError, InputError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            raise at_key("file", f"{self.file}: cannot be read: {why}") from None
        except (KeyError, DefinitionError) as error:
            raise at_key("file", f"{where}: {error.args[0] if error.args else error}") from None
        if not len(found) or not np.isfinite(found).all():
            raise at_key(
                "file", f"{where}: expected seconds, found {'none' if not len(found) else 'what is no number'}"
            )
        if (found < 0).any():
            raise at_key("file", f"{where}: {counted(int((found < 0).sum()), 'negative value')}")
        self._sorted_s = tuple(np.sort(found).tolist())
        return self

    @property
    def sorted_s(self) -> tuple[float, ...]:
        """What was recorded, in seconds."""
        return self._sorted_s

    def delays(self, uniform: Float) -> Float:
        """(K,) quantiles: linear between the order statistics."""
        result: Float = np.quantile(np.array(self._sorted_s), uniform)
        return result

    def _of_topic(self, topic: str) -> Float:
        """Log time − stamp of all messages of a topic, in seconds. Raises KeyError where there are none."""
        log = open_log(Path(self.file))
        channel = next((c for c in log.channels if c.topic == topic), None)
        if channel is None:
            raise KeyError("there is no such topic")
        messages = gathered(log, frozenset({channel.number}))
        definition = definition_of(channel, messages.payloads[channel.number])
        paths = stamps_in(definition.offers(), self.stamp)
        if not paths:
            raise KeyError(f"its messages have no time at {self.stamp!r}; say `stamp: <field>`")
        found = take_apart(definition, messages.payloads[channel.number], texts=paths).levels[""]
        stamp_ns, said, _ = nanoseconds([found.texts[path] for path in paths], "ns")
        logged_ns = np.array(messages.log_time_ns[channel.number], dtype=np.int64)[found.parent]
        delay_s: Float = (logged_ns - stamp_ns)[said] * np.float64(1e-9)
        return delay_s


def _of_column(path: Path, column: str) -> Float:
    """A column of numbers. Raises KeyError where the file has none of this name."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file)
        if column not in (rows.fieldnames or ()):
            raise KeyError(f"there is no such column; there are {', '.join(rows.fieldnames or ('none',))}")
        texts = [row[column] for row in rows]
    try:
        return np.array([float(text) for text in texts])
    except (ValueError, TypeError):
        return np.array([np.nan])
