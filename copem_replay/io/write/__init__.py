"""A replay as MCAP: the recording untouched, and what each configuration lists."""
