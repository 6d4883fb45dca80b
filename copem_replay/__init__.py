"""Replay of recorded traffic through (cooperative) perception error models."""

from copem_replay.core import compiled as _compiled  # noqa: F401 (prepares the cache, before Numba is imported)
