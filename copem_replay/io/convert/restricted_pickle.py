"""Unpickling that builds nothing but containers, numbers, strings and plain numpy arrays.

A pickle is a program that may call whatever it names. Here it can name a dozen harmless functions and types; any other
name is refused before it is imported. What a pickle says of an array is checked before numpy gets it: bytes declared as
references, or a list shorter than the shape, would make numpy read foreign memory. A few bytes of a pickle cannot ask
for gigabytes, neither at once nor by holding one list many times.
"""

from __future__ import annotations

import collections
import io
import math
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, SupportsIndex

import numpy as np

from copem_replay.core.errors import InputError

_TIMES: Final = 16
"""Most numbers and characters made of a file, in bytes of the file; about 1 is usual."""
_DEEPEST: Final = 100
"""Most levels of containers in each other; 6 are usual."""
_ORDERS: Final = ("<", ">", "=", "|")

_NDARRAY: Final = object()
"""Stands for the class of arrays: pickles name it, and may not call it."""
_KIND: Final = object()
"""Stands for any type that is only named as the factory of a defaultdict."""
_KINDS: Final = ("bool", "dict", "float", "int", "list", "long", "str", "tuple", "unicode")


class _Dtype:
    """Type of an array: plain numbers, strings and references, no records. Of its state only the byte order is used."""

    __slots__ = ("dtype",)

    def __init__(self, name: str) -> None:
        dtype = np.dtype(str(name))
        if dtype.kind not in "biufcSUO" or dtype.names is not None or dtype.subdtype is not None:
            raise pickle.UnpicklingError(f"an array of {name}")
        self.dtype = dtype

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, order, *parts = state[:5]
        if order not in _ORDERS or any(part is not None for part in parts):
            raise pickle.UnpicklingError(f"an array of {self.dtype} with parts")
        self.dtype = self.dtype.newbyteorder(order)


class _Array(np.ndarray[Any, Any]):
    """An array whose content is checked to be as large as its shape."""

    take_from: Callable[[int], None]

    def __setstate__(self, state: Any) -> None:
        _version, shape, declared, fortran, content = state
        dtype = _plain_dtype(declared)
        if self.shape != (0,) or not all(type(n) is int and n >= 0 for n in shape):
            raise pickle.UnpicklingError(f"an array of shape {shape}")
        expected = math.prod(shape) * (1 if dtype.hasobject else dtype.itemsize)
        if type(content) is not (list if dtype.hasobject else bytes) or len(content) != expected:
            raise pickle.UnpicklingError(f"an array of shape {shape} with other content")
        self.take_from(expected)
        del self.take_from
        super().__setstate__((1, shape, dtype, bool(fortran), content))  # type: ignore[arg-type]

    def __repr__(self) -> str:
        return repr(self.view(np.ndarray))


class _RefusedError(Exception):
    """The pickle names something that is not allowed."""


class _RestrictedUnpickler(pickle.Unpickler):
    """Everything that a pickle may name, by module and name, old and new; nothing is imported."""

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self._left = _TIMES * len(data)
        self._safe: dict[tuple[str, str], Any] = {
            ("collections", "OrderedDict"): lambda items=(): collections.OrderedDict(self._counted(items)),
            ("collections", "defaultdict"): lambda factory=None: {},  # its factory is never called
            ("_codecs", "encode"): self._encode,
            ("numpy", "ndarray"): _NDARRAY,
            ("numpy", "dtype"): lambda name, align=False, copy=False: _Dtype(name),
        }
        for module in ("builtins", "__builtin__"):
            self._safe |= {(module, kind): _KIND for kind in _KINDS}
            self._safe |= {
                (module, "complex"): lambda real, imag: complex(real, imag),
                (module, "bytes"): lambda: b"",  # empty bytes in old pickles
                (module, "set"): lambda items=(): set(self._counted(items)),
                (module, "frozenset"): lambda items=(): frozenset(self._counted(items)),
            }
        for core in ("numpy.core", "numpy._core"):
            self._safe[f"{core}.multiarray", "_reconstruct"] = self._reconstruct
            self._safe[f"{core}.multiarray", "scalar"] = self._scalar
            self._safe[f"{core}.numeric", "_frombuffer"] = self._from_buffer

    def find_class(self, module: str, name: str) -> Any:
        try:
            return self._safe[module, name]
        except KeyError:
            raise _RefusedError(f"{module}.{name}") from None

    def _take(self, many: int) -> None:
        self._left -= many
        if self._left < 0:
            raise pickle.UnpicklingError("far more content than it has bytes")

    def _counted(self, items: Any) -> Any:
        self._take(len(items))
        return items

    def _encode(self, text: str, encoding: str = "latin1") -> bytes:
        """Bytes as old pickles spell them; other codecs are refused, since some of them decompress."""
        if encoding != "latin1":
            raise pickle.UnpicklingError(f"bytes as {encoding}")
        encoded: bytes = self._counted(text).encode("latin1")
        return encoded

    def _reconstruct(self, kind: object, shape: tuple[int, ...], dtype: object) -> _Array:
        """Return an empty array, which its state fills; a request for a larger one is refused."""
        if kind is not _NDARRAY or shape != (0,):
            raise pickle.UnpicklingError(f"an array of shape {shape} without content")
        array = _Array((0,))
        array.take_from = self._take
        return array

    def _scalar(self, dtype: _Dtype, content: bytes) -> Any:
        kind = _plain_dtype(dtype)
        if kind.hasobject or type(content) is not bytes or len(content) != kind.itemsize:
            raise pickle.UnpicklingError(f"a number of {kind} with other content")
        self._take(len(content))
        return np.frombuffer(content, kind)[0] if kind.itemsize else kind.type()

    def _from_buffer(
        self, content: bytes | bytearray, dtype: _Dtype, shape: tuple[SupportsIndex, ...], order: Any, axes: Any = None
    ) -> Any:
        """Return an array over bytes, which it does not copy."""
        if type(content) not in (bytes, bytearray):
            raise pickle.UnpicklingError("an array over something else than bytes")
        flat = np.frombuffer(content, _plain_dtype(dtype))
        if order == "K" and axes is not None:
            return flat.reshape(shape, order="C").transpose(axes)
        return flat.reshape(shape, order=order)


def _plain_dtype(dtype: _Dtype) -> np.dtype[Any]:
    if type(dtype) is not _Dtype:
        raise pickle.UnpicklingError("an array without a type")
    return dtype.dtype


def _check_memo(data: bytes) -> None:
    """Refuse an index of the memo far beyond the file's size: as many places would be allocated for it."""
    for number, (code, argument, _) in enumerate(pickletools.genops(data)):
        if code.name in ("PUT", "BINPUT", "LONG_BINPUT") and not 0 <= int(argument or 0) <= number:
            raise pickle.UnpicklingError(f"a memo of {argument} places")


def _unfolded_size(thing: Any, known: dict[int, int], depth: int = 0) -> int:
    """The size of a value when all of it is visited: parts held twice count twice. Raises UnpicklingError: a circle."""
    if isinstance(thing, str | bytes | bytearray):
        return 1 + len(thing)
    if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
        return 1 + thing.size
    if not isinstance(thing, dict | list | tuple | set | frozenset | np.ndarray):
        return 1
    if id(thing) not in known:
        if depth == _DEEPEST:
            raise pickle.UnpicklingError(f"containers in each other, more than {_DEEPEST} deep")
        items = (*thing.keys(), *thing.values()) if isinstance(thing, dict) else thing
        flat = items.flat if isinstance(items, np.ndarray) else items
        known[id(thing)] = 1 + sum(_unfolded_size(item, known, depth + 1) for item in flat)
    return known[id(thing)]


def load_pickle(path: Path) -> Any:
    """Return the value in the file. Raises InputError: it names what is not allowed, or is no pickle."""
    try:
        data = path.read_bytes()
        _check_memo(data)
        found = _RestrictedUnpickler(data).load()
        if _unfolded_size(found, {}) > _TIMES * len(data):
            raise pickle.UnpicklingError("far more content than it has bytes")
        return found
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
