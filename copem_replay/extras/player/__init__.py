"""A player of one run on the page of the report."""
