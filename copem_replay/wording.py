"""How counts read in notes and messages."""

from __future__ import annotations


def printable(text: str) -> str:
    """On one line, and without what a terminal would act on: names in a recording may hold anything."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def counted(number: int, noun: str, plural: str = "") -> str:
    """`1 message`, `2 messages`; `plural` where it is not the noun with an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
