"""Unpickling that builds nothing but containers, numbers, strings and plain numpy arrays.

A pickle is a program: it may call whatever it names. Here it can name a dozen harmless things; the first other
name stops it, before anything of it is imported. Nor can a few bytes of it ask for gigabytes.
"""

from __future__ import annotations

import collections
import io
import pickle
import pickletools
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy._core import multiarray, numeric

from copem_replay.errors import InputError


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How old pickles spell bytes; no other codec, some of them unpack."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes as {encoding}")
    return text.encode("latin1")


def _dtype(name: str, align: object = False, copy: object = False) -> np.dtype[Any]:
    """Plain numbers, strings and references only: no records."""
    dtype = np.dtype(name, align=bool(align), copy=bool(copy))
    if dtype.kind not in "biufcSUO" or dtype.names is not None or dtype.subdtype is not None:
        raise pickle.UnpicklingError(f"an array of {name}")
    return dtype


def _reconstruct(kind: type[np.ndarray[Any, Any]], shape: tuple[int, ...], dtype: object) -> np.ndarray[Any, Any]:
    """Return an empty array, which its state fills: no pickle asks for a larger one."""
    if kind is not np.ndarray or shape != (0,):
        raise pickle.UnpicklingError(f"an array of shape {shape} without content")
    return np.empty(0)


_SAFE: Final[dict[tuple[str, str], Any]] = {
    **{(module, kind.__name__): kind for module in ("builtins", "__builtin__") for kind in (set, frozenset, complex)},
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("_codecs", "encode"): _encode,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): _dtype,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _reconstruct for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): multiarray.scalar for core in ("core", "_core")},
    **{
        (f"numpy.{core}.numeric", "_frombuffer"): numeric._frombuffer  # type: ignore[attr-defined]
        for core in ("core", "_core")
    },
}
"""By module and name, old and new: they are looked up here, nothing is imported."""


class _RefusedError(Exception):
    """The pickle names something else."""


class _Restricted(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _SAFE[module, name]
        except KeyError:
            raise _RefusedError(f"{module}.{name}") from None


def _check_memo(data: bytes) -> None:
    """Refuse an index far beyond what there is to remember: as many places would be made for it."""
    for number, (code, argument, _) in enumerate(pickletools.genops(data)):
        if code.name in ("PUT", "BINPUT", "LONG_BINPUT") and not 0 <= int(argument or 0) <= number:
            raise pickle.UnpicklingError(f"a memo of {argument} places")


def load(path: Path) -> Any:
    """Return what the file holds. Raises InputError: it names anything else, or is no pickle."""
    try:
        data = path.read_bytes()
        _check_memo(data)
        return _Restricted(io.BytesIO(data)).load()
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except _RefusedError as error:
        raise InputError(
            f"{path}: refused: the pickle names {error}; expected only containers, numbers, strings and numpy arrays. "
            "Do not load it elsewhere unless you trust where it is from"
        ) from None
    except Exception as error:  # bytes that are no pickle, or a hostile one, can raise about anything
        what = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: expected a pickle, found something else: {what}") from None
