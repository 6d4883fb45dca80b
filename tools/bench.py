"""Benchmarks, one JSON line each. Ratios are taken within one run: trust them, not the absolute figures.

python tools/bench.py [name …]

Each section runs in a process of its own, one after the other, and ends with a line of what it took: of the processor,
of the clock, and the most memory.
"""

from __future__ import annotations

import json
import sys

from benches import (
    commands,
    common,
    compare,
    compiling,
    crew,
    fit,
    fusion,
    links,
    long,
    memory,
    peers,
    reading,
    replay,
    scaling,
    slices,
    why,
    writing,
)

BENCHES = (
    compiling.compile, commands.pieces, compare.compare, compare.verdict, slices.slices, crew.crew, replay.visibility,
    replay.solids, replay.site, memory.memory, fit.fit, replay.paper, reading.reading, writing.writing,
    commands.commands, commands.reports, fusion.fusion, peers.peers, links.links, why.why, scaling.scaling,
    long.crowd, long.long,
)  # fmt: skip
"""All there are, in the order in which they run; each is called without arguments, by its name."""
ALONE = "--alone"
"""Before a name: the section runs in this process."""


def main(names: list[str]) -> None:
    known = {bench.__name__: bench for bench in BENCHES}
    alone = names[:1] == [ALONE]
    if unknown := [name for name in names[alone:] if name not in known]:
        raise SystemExit(f"expected some of {', '.join(known)}; found {', '.join(unknown)}")
    if alone:
        for line in known[names[1]]():
            print(json.dumps(line), flush=True)
        return
    for name in known:
        if not names or name in names:
            took = common.spent((ALONE, name), command=(sys.executable, __file__), stdout=None)
            print(json.dumps({"section": name} | common.as_line(took)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
