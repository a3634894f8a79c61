"""``body_tracking doctor``: finds out why no data arrive, and states a remedy.

``environment`` checks the shell, ``bags`` a recording, ``live`` the ROS domain; each yields findings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

OK: Final = "OK"
WARNING: Final = "warning"
PROBLEM: Final = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check, with a remedy; a problem keeps the graph from working."""

    level: Literal["OK", "warning", "problem"]
    found: str
    remedy: str = ""
