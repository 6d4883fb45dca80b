"""Types everything shares: scenes, tracks, object lists, random numbers, geometry, errors."""
