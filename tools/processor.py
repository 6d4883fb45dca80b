"""On which processor pages and notebooks are written: one that every x86-64 of the last ten years can stand for.

NumPy and OpenBLAS choose their code by processor, and the last bits of a sine or of a sum differ with it. A detection
that hangs on the last bit is then another; of thousands one does. What pages show is made with code that all have.
"""

from __future__ import annotations

import os
import platform

PLAIN = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENBLAS_NUM_THREADS": "1",
}

IS_X86 = platform.machine() in {"x86_64", "AMD64"}
"""Whether this machine can stand for it; others round otherwise, so there pages are not held against commands."""


def plain_environment() -> dict[str, str]:
    """The environment of a process whose numbers are those of the pages, on any x86-64."""
    return dict(os.environ) | PLAIN
