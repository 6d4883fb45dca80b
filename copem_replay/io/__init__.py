"""Recordings in (containers, encodings, schemas: ground truth and recorded lists) and out (MCAP)."""
