"""What channels of unknown schemas could be read as: `read:` of an experiment, proposed and tried."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

from pydantic import ValidationError

from copem_replay.core.errors import RecordingError
from copem_replay.experiment.draft.field_guess import propose, stamp_paths
from copem_replay.experiment.draft.findings import ProposalFound
from copem_replay.io.channel import Channel
from copem_replay.io.encodings.columns import take_apart
from copem_replay.io.encodings.definition import definition_of
from copem_replay.io.encodings.raw_values import DefinitionError
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.recording import Recording, foreign, read
from copem_replay.io.schemas.description import Fields
from copem_replay.io.schemas.pose_schemas import is_pose
from copem_replay.io.schemas.registry import is_list

_CHANNELS = 30
"""So many channels of a recording are looked at (chosen)."""
_SAMPLES = 50
"""So many messages of each (chosen)."""
_OFFERS = 40
"""So many fields are named where not all were found (chosen)."""


def proposals(log: Log, name: str) -> Iterator[tuple[ProposalFound, Recording | None]]:
    """Each channel that looks like a list of objects, and what it is read as, None where it is not."""
    unknown = [c for c in foreign(log) if not is_list(c) and not is_pose(c)]
    for channel in unknown[:_CHANNELS]:
        try:
            found = _proposed(log, channel)
        except (DefinitionError, BrokenIndexError, RecordingError):
            continue
        if found is None:
            continue
        recording, problem = None, None
        if not found.missing:
            try:
                recording = read(log, name=name, topic=channel.topic, fields=fields_of(found))
            except RecordingError as error:
                problem = "; ".join(error.within(log.path))
            except BrokenIndexError as error:
                problem = error.reason
            except ValidationError as error:
                problem = str(error)
        yield replace(found, problem=problem), recording


def fields_of(found: ProposalFound) -> Fields:
    """The fields as they are proposed. Raises ValidationError."""
    return Fields.model_validate({key: value for key, value in found.read.items() if key != "topic"})


def _proposed(log: Log, channel: Channel) -> ProposalFound | None:
    samples = list(itertools.islice(log.payloads(frozenset({channel.number})), _SAMPLES))
    payloads, times = [data for _, _, data in samples], [at for _, at, _ in samples]
    definition = definition_of(channel, payloads)
    offers = definition.offers()
    paths = stamp_paths(offers)
    said = take_apart(definition, payloads, texts=paths).levels[""]
    words = {p: [said.texts[p].words[k] if k >= 0 else "" for k in said.texts[p].code] for p in paths}
    found = propose(offers, words, [times[m] for m in said.parent])
    if found is None:
        return None
    return ProposalFound(
        topic=channel.topic,
        schema=channel.schema,
        read={"topic": channel.topic, **found[0]},
        missing=found[1],
        offers=list(offers)[:_OFFERS],
    )
