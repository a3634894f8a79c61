"""The base class of every error that the package raises on purpose, and the hint to a similar name in its text.

A module owns its own exception, derived from this one; a caller that only shows the text catches the base.
"""

from collections.abc import Collection, Iterable
from difflib import get_close_matches


class BodyTrackingError(Exception):
    """Something outside the program is wrong; the text names the problem and its place in one line."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """``; did you mean 'x'?`` with the most similar known name; empty where none is similar."""
    by_letters = {str(each).casefold().lstrip("-"): str(each) for each in known}
    similar = get_close_matches(str(name).casefold().lstrip("-"), by_letters, n=1)
    return f"; did you mean {by_letters[similar[0]]!r}?" if similar else ""


def one_of(name: object, known: Collection[str]) -> str:
    """``expected one of a, b``, and the hint to a similar name."""
    return f"expected one of {', '.join(known)}{did_you_mean(name, known)}"
