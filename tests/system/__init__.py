"""Tests of the whole: commands, documents, tools, pictures."""
