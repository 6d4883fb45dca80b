"""What the regret of a stack's recorded output is to: ideal fusion of its inputs, by plain data of the experiment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from copem_replay.results.compare.labels import Named
    from copem_replay.results.read import Results


def ideals(results: Results) -> dict[str, str | None]:
    """By recorded output its ideal; None: it does not say what it was made of, or no configuration is ideal."""
    configurations = results.source.data.get("configurations") or {}
    of_name = {str(name): said for name, said in configurations.items() if isinstance(said, dict)}
    return {
        name: next((other for other, one in of_name.items() if _is_ideal_over(one, said.get("inputs"))), None)
        for name, said in of_name.items()
        if said.get("recorded")
    }


def _is_ideal_over(said: dict[str, Any], inputs: object) -> bool:
    units, fusion = said.get("units"), said.get("fusion") or {}
    return (
        isinstance(units, list)
        and isinstance(inputs, list)
        and set(map(str, units)) == set(map(str, inputs))
        and {"kind": "ideal", "combine": "samples"} | fusion == {"kind": "ideal", "combine": "samples"}
        and not said.get("latency_s")
        and not said.get("link")
        and not said.get("issue_hz")
    )


def notes_on_outputs(baseline: Named, others: Sequence[Named]) -> Iterator[str]:
    """Where the difference of a recorded output to the baseline is no regret."""
    for one in others:
        of_folder = ideals(one.results)
        if one.configuration not in of_folder:
            continue
        ideal = of_folder[one.configuration]
        if ideal is None:
            yield f"{one.label}: no regret, for it has no `inputs`: only a difference to {baseline.label}"
        elif baseline.configuration != ideal:
            yield f"{one.label}: its regret is to {ideal}, ideal fusion of its inputs (--baseline {ideal})"
