"""What `tools/fuzz.py` reads: recordings taken apart, hit, and put together again in every container."""
