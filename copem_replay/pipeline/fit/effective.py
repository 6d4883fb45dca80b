"""How many rows are worth one that is independent: rows of a pass hang together."""

from __future__ import annotations

from copem_replay.core.tracks import Float, Int

_LONGEST = 400
"""Lists over which the correlation is followed (chosen)."""


def rows_per_effective(residual: Float, pass_ix: Int) -> float:
    """1 + 2 Σ ρₖ, at least 1, of what was seen less what was expected (R,), in the order of passes and lists.

    ρₖ: correlation of rows of a pass that are k apart, each pair counted once, as in the sum (1 − k/m) ρₖ of a pass of
    m. Summed in pairs of neighbours until a pair is not positive (Geyer, Statist. Sci. 7 (1992) 473–483).
    """
    whole = float(residual @ residual)
    if whole == 0:
        return 1.0
    total, one = 0.0, 0.0
    for k in range(1, min(_LONGEST, len(residual))):
        same = pass_ix[k:] == pass_ix[:-k]
        if not same.any():
            break
        here = float((residual[k:] * residual[:-k])[same].sum()) / whole
        if k % 2 == 0 and one + here <= 0:
            break
        if k % 2 == 0:
            total += one + here
        one = here
    return max(1 + 2 * total, 1.0)
