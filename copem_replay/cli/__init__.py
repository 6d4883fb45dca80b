"""Commands, options, exit codes: a few lines around the library each."""
