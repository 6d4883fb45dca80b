"""Perception error models: conditions, detection models, error models."""
