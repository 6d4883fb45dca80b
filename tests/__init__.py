"""Tests, by wing of the package."""
