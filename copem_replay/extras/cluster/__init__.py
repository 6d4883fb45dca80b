"""Processes on this machine or on others that survey logs and compute parts (docs/guide/scale.md)."""
