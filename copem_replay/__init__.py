"""Replay of recorded traffic through (cooperative) perception error models."""

from pathlib import Path as _Path

from copem_replay.core.compiled import prepare_cache as _prepare_cache

CACHE_NOTE = _prepare_cache(_Path(__file__).parent)
"""What has to be said of where compiled code is cached: None, nothing."""
