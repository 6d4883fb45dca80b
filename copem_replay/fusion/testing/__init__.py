"""The conformance kit for own fusions."""
