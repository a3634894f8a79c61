"""What a check says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

Level: TypeAlias = Literal["OK", "warning", "problem"]

OK: Final = "OK"
WARNING: Final = "warning"
PROBLEM: Final = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        check: what kind of thing, in a word.
        level: a problem keeps the graph from working; a warning makes it worse or will surprise somebody.
        found: one line.
        remedy: what to do, a command where there is one; empty where all is well.
    """

    check: str
    level: Level
    found: str
    remedy: str = ""
