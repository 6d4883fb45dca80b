"""Tests of what the main job does not need: not collected where `copem_replay/extras/` is not there."""
