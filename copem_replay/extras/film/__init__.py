"""Ten seconds of an object in one run, as a GIF for slides."""
