"""Compiled functions of inner loops, and the references to arrays that Numba counts.

At each call Numba counts, atomically, references to each array that is handed over. Of a function called for each entry
that takes several times as long as what it does. The option is private to Numba, and what is called inherits it:
docs/develop/decisions/0039-counted-references.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba as nb

Function = TypeVar("Function", bound=Callable[..., Any])
_njit: Any = nb.njit  # whose stubs leave the option out

borrowing: Callable[[Function], Function] = _njit(cache=True, nogil=True, _nrt=False)
"""As `nb.njit`, for functions that make no array and return none: what they are handed outlives them."""

making: Callable[[Function], Function] = _njit(cache=True, nogil=True, _nrt=True)
"""As `nb.njit`, for functions that make arrays and are called by such."""
