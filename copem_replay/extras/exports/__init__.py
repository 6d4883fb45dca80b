"""Results in formats of other tools: GeoJSON, TrackEval, nuScenes."""
