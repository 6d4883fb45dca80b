"""Fusion: what the receiver believes, from the lists that have arrived (f of the paper's coPEM)."""
