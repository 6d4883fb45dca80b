"""Require: the value of a key from which on, or up to which, a criterion holds."""
