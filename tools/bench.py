"""Benchmarks, one JSON line each. Ratios are taken within one run: trust them, not the absolute figures.

python tools/bench.py [name …]
"""

from __future__ import annotations

import json
import sys

from benches import commands, compare, crew, fit, fusion, links, long, memory, reading, replay, slices, writing

BENCHES = (
    commands.pieces, compare.compare, compare.verdict, slices.slices, crew.crew, replay.visibility, memory.memory,
    fit.fit, replay.paper, reading.reading, writing.writing, commands.commands, commands.reports, fusion.fusion,
    fusion.peers, links.links,
    long.crowd, long.long,
)  # fmt: skip
"""All there are, in the order in which they run; each is called without arguments, by its name."""


def main(names: list[str]) -> None:
    known = {bench.__name__: bench for bench in BENCHES}
    if unknown := [name for name in names if name not in known]:
        raise SystemExit(f"expected some of {', '.join(known)}; found {', '.join(unknown)}")
    for name, bench in known.items():
        if not names or name in names:
            for line in bench():
                print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
