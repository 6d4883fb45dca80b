"""The report of a fitted unit: what was estimated, how well it is known, and pictures that show where it fails."""
