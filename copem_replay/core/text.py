"""How counts and kinds of intervals read in notes, messages and tables."""

from __future__ import annotations


def printable(text: str) -> str:
    """On one line, and without what a terminal would act on: names in a recording may hold anything."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def counted(number: int, noun: str, plural: str = "") -> str:
    """`1 message`, `2 messages`; `plural` where it is not the noun with an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def interval_words(kind: str, over: str) -> str:
    """What limits are, by their kind and what they are over in `summary.csv`; unknown kinds as they are."""
    words = {
        "wilson": "Wilson interval over {}",
        "bootstrap": "bootstrap interval over {}",
        "bootstrap+exact": "bootstrap interval over {}, nowhere narrower than exact binomial limits",
    }
    return words.get(kind, f"{kind} interval over {{}}").format(over)
