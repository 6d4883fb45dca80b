"""Layouts of a replay for Foxglove and Lichtblick."""
