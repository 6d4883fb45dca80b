"""What the main job does not need, a folder each. The core finds them by the table of `core/extras.py` alone."""
