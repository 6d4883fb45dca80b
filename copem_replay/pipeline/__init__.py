"""Runs an experiment: one log, blocks of runs, time chunks, sweeps, closed form."""
