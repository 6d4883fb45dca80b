"""Verdicts of many results folders on one page."""
