"""The results folder: written, read back, configurations compared with a baseline."""
