"""Parts: what one log gives in one configuration in a block of runs is kept, and found again by the hash of its recipe.

    parts/ab/<key>.arrows   rows of `detections.parquet`, and what stands beside them, behind a line with their digest
    logs/<key>.record       the facts of a log, so that it need not be read again, behind such a line

They are in a folder or under a URL. Two processes that write the same part write the same bytes. The recipe is all that
a part is made of, as canonical JSON: the log's resolved experiment without what cannot change a row, NOT_OF_A_PART.
That is right as draws have addresses, and as adding a unit, a configuration or an object changes no other draw
(docs/develop/decisions/scale.md).
"""

from __future__ import annotations

import hashlib
import inspect
import json
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from pydantic import BaseModel

from copem_replay.core.components import Component
from copem_replay.core.errors import (
    InputError,
    OutputError,
    check_answering,
    is_own,
    is_url,
    local_path,
    open_file_system,
    reraise_in_one_line,
    strip_credentials,
)
from copem_replay.core.files import atomic_file, parse_json
from copem_replay.core.waiting import await_server
from copem_replay.experiment.drive import RecordedLatency, cache_last_experiment
from copem_replay.experiment.maps import MapFile
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.io.config import TruthFields, TruthTopic
from copem_replay.metrics.onset import Requires
from copem_replay.pipeline.tables import PartTables, pack_part, unpack_part

# Stores: bytes by name, in a folder or under a URL. A name is complete or missing. `where` is the address of a store
# without credentials, for messages. A store is pickled as its address: every process opens its own.

_OPTION = "--pieces: "
MARK = "parts.txt"
"""Written once under a URL: a bucket that is missing, or cannot be written, is found out before any run."""


def open_store(address: str | Path) -> Store:
    """The store in a folder, or under a URL. Raises InputError, OutputError."""
    if isinstance(address, Path) or not is_url(address := local_path(address)):
        return FolderStore(Path(address))
    return BucketStore(address)


class FolderStore:
    """A folder of this machine or a shared one. Files are written under a temporary name and renamed."""

    def __init__(self, root: Path) -> None:
        self.root, self.where = root, str(root)
        try:
            for name in ("parts", "logs"):
                (root / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{_OPTION}{root}: cannot be written: {error.strerror or error}") from error

    def exists(self, name: str) -> bool:
        """Whether the file exists."""
        return (self.root / name).is_file()

    def read(self, name: str) -> bytes | None:
        """The content of a file; None: it does not exist. Raises OSError."""
        try:
            return (self.root / name).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, name: str, content: bytes) -> None:
        """Write a file: complete, or not at all. Raises OutputError."""
        with atomic_file(self.root / name, flush=False) as scratch:  # the seal of a file that a crash damages is wrong
            scratch.write_bytes(content)

    def refresh(self) -> None:
        """Nothing to do: files are looked up when they are asked for."""


class BucketStore:
    """Object storage, by fsspec: one request writes a whole object, and one listing gives all names."""

    def __init__(self, url: str) -> None:
        self.url, self.where = url.rstrip("/"), strip_credentials(url).rstrip("/")
        if urlsplit(url).query:
            raise InputError(f"{_OPTION}{self.where}: expected a URL without a query, names are put behind it")
        if MARK not in self._listed:
            self.write(MARK, b"parts of copem-replay\n")

    def __getstate__(self) -> dict[str, Any]:
        """The address alone: connections belong to one process."""
        return {"url": self.url, "where": self.where}

    @cached_property
    def _opened(self) -> tuple[Any, str]:
        fs, path = open_file_system(self.url, _OPTION)
        return fs, path.rstrip("/")

    @cached_property
    def _listed(self) -> set[str]:
        fs, path = self._opened
        with reraise_in_one_line(self.url, prefix=_OPTION):
            fs.invalidate_cache()
            check_answering(self.url, fs, f"{path}/{MARK}")
            paths = await_server(self.where, lambda _: fs.find(path), works=True)
        return {name.partition(f"{path}/")[2] for name in paths}

    def exists(self, name: str) -> bool:
        """Whether the last listing has the name, or this process has written it since."""
        return name in self._listed

    def read(self, name: str) -> bytes | None:
        """The content of an object; None: the last listing lacks it. Raises InputError."""
        fs, path = self._opened
        if name not in self._listed:
            return None
        with reraise_in_one_line(f"{self.url}/{name}", prefix=_OPTION):
            try:
                content: bytes = await_server(self.where, lambda _: fs.cat_file(f"{path}/{name}"))
            except FileNotFoundError:  # removed after the listing
                return None
        return content

    def write(self, name: str, content: bytes) -> None:
        """Write an object in one request: complete, or not at all. Raises OutputError."""
        fs, path = self._opened
        with reraise_in_one_line(f"{self.url}/{name}", OutputError, _OPTION):
            await_server(self.where, lambda _: fs.pipe_file(f"{path}/{name}", content), works=True)
        if "_listed" in self.__dict__:
            self._listed.add(name)

    def refresh(self) -> None:
        """List anew when a name is asked for next, and find what other processes have written."""
        self.__dict__.pop("_listed", None)


Store: TypeAlias = FolderStore | BucketStore


# Recipes, and the keys that name them.

NOT_OF_A_PART: Mapping[str, str] = {
    "logs": "which log, and how it is read, is in the recipe itself; other logs are not",
    "runs": "the block of runs is in the recipe itself",
    "show": "what is shown is replayed after gathering",
    "criteria": "rows are judged once they are there",
    "sweep": "each of its points is an experiment of its own",
    "configurations": "only the part's own, without its name",
    "units": "only those that the configuration, the onset or the reference of distances goes by",
    "pems": "only those of these units",
    "links": "only those that the configuration sends by",
    "tags": "only where a PEM asks for some",
    "measure.began": "rows that do not count are replayed, too",
    "measure.horizon_s": "restricted means are taken of all rows",
    "measure.exact": "closed forms draw nothing",
    "measure.metrics": "own metrics are taken of all rows",
    "measure.by": "groups are of all rows",
}
"""Keys of the experiment that are not in a recipe as they are, and why."""
_LIBRARIES = ("numba", "numpy", "pandas", "pyarrow", "scipy", "shapely")


def canonical_json(data: Any) -> str:
    """JSON: keys sorted, numbers as short as they read back, UTF-8."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def recipe_key(recipe: str) -> str:
    """The key of a recipe: its BLAKE2b digest, 160 bits, in hexadecimal digits."""
    return hashlib.blake2b(recipe.encode(), digest_size=20).hexdigest()


@cache
def take_fingerprint() -> dict[str, str]:
    """The versions that numbers depend on beside the recipe: this package and its sources, libraries, Python, libc."""
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


def write_recipe(experiment: Experiment, name: str, log: Mapping[str, Any], runs: tuple[int, int] | None) -> str:
    """The recipe of a configuration of an experiment that is resolved for one log (`resolve_for_log`).

    `log`: `StudyLog.identity`. `runs`: from, up to; None for closed forms, which draw nothing.
    """
    data, own = _recipe_parts(experiment, name)
    return canonical_json(data | {"log": dict(log), "runs": runs, "own": file_digests(own, experiment.read)})


@cache_last_experiment
def _recipe_parts(experiment: Experiment, name: str) -> tuple[dict[str, Any], list[Component | MapFile]]:
    """All settings that a part's rows depend on, and the components and maps whose content is hashed too."""
    data = experiment.as_written()
    configuration = experiment.configurations[name]
    units, members = _list_dependencies(experiment, configuration), experiment.units_of(configuration)
    pems = [pem for unit in units if (pem := experiment.units[unit].pem) is not None]
    links = [link for unit in members if isinstance(link := configuration.link_of(unit), str)]
    of_part = {
        "part": 3,
        "fingerprint": take_fingerprint(),
        "configuration": data["configurations"][name] | ({"units": members} if members else {}),
        "units": [(unit, data["units"][unit]) for unit in units],  # in the experiment's order, which decides ties
        "pems": {pem: data["pems"][pem] for pem in pems},
        "links": {link: data["links"][link] for link in links},
    }
    if any(couple.when.tags for pem in pems for couple in experiment.pems[pem].couples):
        of_part["tags"] = experiment.tags
    if experiment.has_areas:
        of_part["areas_named"] = True  # a column of the rows, of a log without areas, too
    components = own_components(
        configuration, experiment.visibility, experiment.measure.model_copy(update={"metrics": ()}),
        experiment.braking, *(experiment.pems[pem] for pem in pems),
        *(experiment.units[unit] for unit in units), *(experiment.links[link] for link in links), *experiment.maps,
    )  # fmt: skip
    for key in NOT_OF_A_PART:
        section, _, last = key.rpartition(".")
        (data[section] if section else data).pop(last, None)
    return data | of_part, components


def _list_dependencies(experiment: Experiment, configuration: Configuration) -> list[str]:
    """The units that rows of a configuration depend on, in the experiment's order."""
    measure, heard = experiment.measure, experiment.units_of(configuration)
    members = {*heard, *experiment.list_sensing(heard)}
    if measure.onset.requires is not Requires.NOTHING or is_own(
        type(measure.onset)
    ):  # such onsets may ask for visibility
        return list(experiment.units)
    return [name for name in experiment.units if name in members or name == measure.distance_to]


def own_components(*models: BaseModel | None) -> list[Component | MapFile]:
    """The parts of models that come from files: the user's own components, recorded latencies, maps."""
    components = (one for model in models for one in _find_components(model))
    return [one for one in components if is_own(type(one)) or isinstance(one, RecordedLatency | MapFile)]


def file_digests(parts: Sequence[Component | MapFile], read: TruthTopic | TruthFields) -> dict[str, str]:
    """SHA-256 of the files that define own components (not of what they import), of recorded latencies, of maps, and of
    definitions of messages.
    """
    files = {kind: Path(inspect.getfile(kind)) for kind in {type(one) for one in parts if is_own(type(one))}}
    contents = {f"{k.__module__}:{k.__qualname__}": f.read_bytes() for k, f in files.items()}
    contents |= {one.file: repr(one.sorted_s).encode() for one in parts if isinstance(one, RecordedLatency)}
    maps = {one.file: one.sha256 for one in parts if isinstance(one, MapFile)}
    definitions = [] if read.definitions is None else sorted(Path(str(read.definitions)).rglob("*.msg"))
    contents |= {str(path): path.read_bytes() for path in definitions}
    return {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()} | maps


def _find_components(value: object) -> Iterator[Component | MapFile]:
    if isinstance(value, Component | MapFile):
        yield value
    if isinstance(value, BaseModel):
        value = [getattr(value, name) for name in type(value).model_fields]
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for one in value:
            yield from _find_components(one)


# Parts as files.

STATES_A_PART, MOST_RUNS = 1 << 22, 256
"""Object states of the runs of a part, and runs, at most: some MB, and seconds of work. More: an experiment of few runs
shares fewer parts with a longer one, and more memory is needed; no result changes."""


def cut_parts(runs: int, object_states: int) -> list[tuple[int, int]]:
    """The blocks of runs, (from, until), that are parts: of a size that depends on the log's size; the last one is cut.

    That many is a power of two: sums of accuracy are a tree over runs. More runs find the parts of fewer.
    """
    size = 1 << min(max(STATES_A_PART // max(object_states, 1), 1), MOST_RUNS).bit_length() - 1
    return [(begin, min(begin + size, runs)) for begin in range(0, runs, size)]


class PartCache:
    """The parts at an address, a folder or a URL. Raises InputError, OutputError where it cannot be used.

    `found`, `computed`: how many parts of a study. `damaged`: a line for each that had to be computed again.
    """

    def __init__(self, address: str | Path, store: Store | None = None) -> None:
        self.address = str(address)
        self.store = open_store(address) if store is None else store
        self.found = self.computed = 0
        self.damaged: list[str] = []

    def read(self, recipe: str, log: str, configuration: str) -> PartTables | None:
        """The part of a recipe; None: it is missing or damaged. Raises InputError."""
        name = part_name(recipe)
        try:
            content = self.store.read(name)
            part = None if content is None else unpack_part(_unseal(content), log, configuration, recipe)
            return part and self._reread(recipe, part)
        except (OSError, ValueError, KeyError, TypeError, IndexError) as error:  # what Arrow raises derives from these
            why = " ".join(str(error).split())[:120]
            self.damaged.append(f"{self.store.where}/{name}: damaged, computed again ({why})")
            return None

    def write(self, recipe: str, part: PartTables) -> PartTables:
        """Cache a part; returns it. Raises OutputError."""
        self.store.write(part_name(recipe), _seal(pack_part(part, recipe)))
        self.computed += 1
        return self._reread(recipe, part)

    def _reread(self, recipe: str, part: PartTables) -> PartTables:
        """The part with how it is read again; as it is under a URL, where that would ask for it twice."""
        log, configuration = part.log, part.configuration  # not the part itself, which would stay in memory

        def again() -> PartTables:
            if (found := self.read(recipe, log, configuration)) is None:
                what = "expected the part that was there before, found none, or a damaged one; run the command again"
                raise InputError(f"{_OPTION}{self.store.where}/{part_name(recipe)}: {what}")
            return found

        return replace(part, again=again) if isinstance(self.store, FolderStore) else part

    def known(self, about: str) -> dict[str, Any] | None:
        """The cached facts of a log under the key `about`; None: missing or damaged."""
        try:
            facts: Any = parse_json(_unseal(self.store.read(_record_name(about)) or b""))
        except (OSError, ValueError):
            return None
        return facts if isinstance(facts, dict) else None

    def keep(self, key: str, facts: Mapping[str, Any]) -> None:
        """Cache facts of a log under `key`. Raises OutputError."""
        self.store.write(_record_name(key), _seal(canonical_json(facts).encode()))

    def forget(self, about: str) -> None:
        """Remove the facts of a log under the key `about`. Raises OutputError."""
        self.store.write(_record_name(about), b"")


def part_name(recipe: str) -> str:
    """The name of a recipe's part in a store."""
    key = recipe_key(recipe)
    return f"parts/{key[:2]}/{key}.arrows"


def _record_name(about: str) -> str:
    return f"logs/{recipe_key(about)}.record"


def _seal(content: bytes) -> bytes:
    """The content behind a line with its digest."""
    return hashlib.blake2b(content, digest_size=20).hexdigest().encode() + b"\n" + content


def _unseal(content: bytes) -> bytes:
    """What `_seal` was given. Raises ValueError where any bit differs."""
    _, _, sealed = content.partition(b"\n")
    if _seal(sealed) != content:
        raise ValueError("another content")
    return sealed
