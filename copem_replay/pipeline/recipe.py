"""Recipe: all that a piece is made of, as canonical JSON, and the key that names it.

A piece is what one log gives in one configuration and one range of runs. Its recipe is the log's resolved experiment
less what cannot change a row: NOT_OF_A_PIECE. That is legitimate as draws have addresses, and as adding a unit, a
configuration or an object changes no other draw (docs/develop/decisions/0031-pieces.md).
"""

from __future__ import annotations

import hashlib
import inspect
import json
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from copem_replay.core.components import Component
from copem_replay.core.own_code import is_own
from copem_replay.experiment.drive import for_all_logs
from copem_replay.experiment.recorded_latency import RecordedLatency
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.metrics.onset import Requires

NOT_OF_A_PIECE: Mapping[str, str] = {
    "logs": "which log, and how it is read, is in the recipe itself; other logs are not",
    "runs": "the range of runs is in the recipe itself",
    "show": "what is shown is replayed after gathering",
    "sweep": "each of its points is an experiment of its own",
    "configurations": "only the piece's own, without its name",
    "units": "only those that the configuration, the onset or the reference of distances goes by",
    "pems": "only those of these units",
    "links": "only those that the configuration sends by",
    "measure.horizon_s": "restricted means are taken of all rows",
    "measure.exact": "closed forms draw nothing",
    "measure.metrics": "own metrics are taken of all rows",
}
"""Keys of the experiment that are not in a recipe as they are, and why."""
_LIBRARIES = ("numba", "numpy", "pandas", "pyarrow", "scipy", "shapely")


def canonical(data: Any) -> str:
    """JSON: keys sorted, numbers as short as they read back, UTF-8."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def key_of(recipe: str) -> str:
    """The name of what is made by a recipe: BLAKE2b, 160 bits."""
    return hashlib.blake2b(recipe.encode(), digest_size=20).hexdigest()


@cache
def fingerprint() -> dict[str, str]:
    """What makes the numbers beside the recipe: this package, the libraries, Python, the machine and its libc."""
    package = Path(__file__).parents[1]
    digest = hashlib.blake2b(digest_size=20)
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package)}\n".encode())
        digest.update(hashlib.blake2b(path.read_bytes()).digest())
    return {
        "copem_replay": f"{version('copem-replay')} {digest.hexdigest()}",
        **{name: version(name) for name in _LIBRARIES},
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()),
    }


def recipe(experiment: Experiment, name: str, log: Mapping[str, Any], runs: tuple[int, int] | None) -> str:
    """Of a configuration of an experiment that is resolved for one log (`of_log`), in runs from … up to.

    `log`: the log's name and content, and how its parts go together. `runs`: None for what draws nothing.
    """
    data, own = _of_every_log(experiment, name)
    return canonical(data | {"log": dict(log), "runs": runs, "own": digests(own)})


@for_all_logs
def _of_every_log(experiment: Experiment, name: str) -> tuple[dict[str, Any], list[Component]]:
    data = experiment.as_written()
    configuration = experiment.configurations[name]
    units, members = _closure(experiment, configuration), experiment.units_of(configuration)
    pems = [pem for unit in units if (pem := experiment.units[unit].pem) is not None]
    links = [link for unit in members if isinstance(link := configuration.link_of(unit), str)]
    mine = {
        "piece": 1,
        "fingerprint": fingerprint(),
        "configuration": data["configurations"][name] | ({"units": members} if members else {}),
        "units": [(unit, data["units"][unit]) for unit in units],  # in the experiment's order, which decides ties
        "pems": {pem: data["pems"][pem] for pem in pems},
        "links": {link: data["links"][link] for link in links},
    }
    own = own_components(
        configuration, experiment.visibility, experiment.measure.model_copy(update={"metrics": ()}),
        experiment.braking, *(experiment.pems[pem] for pem in pems),
        *(experiment.units[unit] for unit in units), *(experiment.links[link] for link in links),
    )  # fmt: skip
    for key in NOT_OF_A_PIECE:
        within, _, last = key.rpartition(".")
        (data[within] if within else data).pop(last, None)
    return data | mine, own


def _closure(experiment: Experiment, configuration: Configuration) -> list[str]:
    """The units that rows of a configuration depend on, in the experiment's order."""
    measure, members = experiment.measure, experiment.units_of(configuration)
    if measure.onset.requires is not Requires.NOTHING or is_own(type(measure.onset)):  # which may ask for visibility
        return list(experiment.units)
    return [name for name in experiment.units if name in members or name == measure.distance_to]


def own_components(*models: BaseModel | None) -> list[Component]:
    """Components that files decide: own ones, and recorded latencies."""
    every = (one for model in models for one in _components(model))
    return [one for one in every if is_own(type(one)) or isinstance(one, RecordedLatency)]


def digests(own: Sequence[Component]) -> dict[str, str]:
    """SHA-256 of the files that own components are written in (not of what these import), and of recorded latencies."""
    files = {kind: Path(inspect.getfile(kind)) for kind in {type(one) for one in own if is_own(type(one))}}
    found = {f"{k.__module__}:{k.__qualname__}": f.read_bytes() for k, f in files.items()}
    found |= {one.file: repr(one.sorted_s).encode() for one in own if isinstance(one, RecordedLatency)}
    return {name: hashlib.sha256(content).hexdigest() for name, content in found.items()}


def _components(value: object) -> Iterator[Component]:
    if isinstance(value, Component):
        yield value
    if isinstance(value, BaseModel):
        value = [getattr(value, name) for name in type(value).model_fields]
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for one in value:
            yield from _components(one)
