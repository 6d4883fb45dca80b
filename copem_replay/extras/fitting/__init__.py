"""A perception error model from recorded lists and the truth beside them: estimates with intervals, and a choice."""
