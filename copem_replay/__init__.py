"""Replay of recorded traffic through (cooperative) perception error models."""
