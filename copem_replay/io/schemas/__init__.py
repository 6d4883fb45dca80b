"""Message formats, one module each: what a payload says, as columns."""
