"""Benchmarks, one JSON line each. Ratios are taken within one run: trust them, not the absolute figures.

python tools/bench.py [--table] [name …]

Each section runs in a process of its own, one after the other, and ends with a line of what it took: of the processor,
of the clock, and the most memory. `--table`: tables for a page, one for all lines with the same keys.
"""

from __future__ import annotations

import json
import subprocess
import sys

from benches import (
    commands,
    common,
    compare,
    compiling,
    crew,
    fit,
    floor,
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
    floor.floor, compiling.compile, commands.pieces, compare.compare, compare.verdict, slices.slices, crew.crew,
    replay.visibility, replay.solids, replay.site, memory.memory, fit.fit, replay.paper, reading.reading,
    writing.writing, commands.commands, commands.reports, fusion.fusion, peers.peers, links.links, why.why,
    scaling.scaling, long.crowd, long.long,
)  # fmt: skip
"""All there are, in the order in which they run; each is called without arguments, by its name."""
ALONE = "--alone"
"""Before a name: the section runs in this process."""
TABLE = "--table"


def main(names: list[str]) -> None:
    known = {bench.__name__: bench for bench in BENCHES}
    if names[:1] == [TABLE]:
        printed = subprocess.check_output([sys.executable, __file__, *names[1:]], text=True)
        said = [line for line in printed.splitlines() if line.startswith("{")]  # peers print words of their own
        print("\n".join(tabulate([json.loads(line) for line in said])))
        return
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


def tabulate(lines: list[common.Line]) -> list[str]:
    """Tables in Markdown: one for all lines with the same keys, without the lines of sections."""
    tables: dict[tuple[str, ...], list[str]] = {}
    for line in lines:
        if "section" not in line:
            cells = ["" if value is None else str(value) for value in line.values()]
            tables.setdefault(tuple(line), []).append(f"| {' | '.join(cells)} |")
    heads = ([f"| {' | '.join(keys)} |", f"|{'---|' * len(keys)}"] for keys in tables)
    return [text for head, rows in zip(heads, tables.values(), strict=True) for text in (*head, *rows, "")][:-1]


if __name__ == "__main__":
    main(sys.argv[1:])
