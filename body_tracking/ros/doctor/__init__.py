"""``body_tracking doctor``: why nothing comes, and what to do about it.

``environment`` looks at the shell, ``bags`` at a recording, ``live`` at the ROS domain; each yields findings. Only
``cli`` imports it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

OK: Final = "OK"
WARNING: Final = "warning"
PROBLEM: Final = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check says: where, how it is, and the one thing to do; a problem keeps the graph from working."""

    level: Literal["OK", "warning", "problem"]
    found: str
    remedy: str = ""
