"""What other installed packages add, by their entry points."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def entry_points_of(group: str) -> tuple[EntryPoint, ...]:
    """The entry points of a group.

    ``importlib.metadata`` is imported only where a package has the group: that, and reading all entry points of all
    packages, is a tenth of a node's start.
    """
    if not any(_names(Path(path), group) for path in sys.path):
        return ()
    from importlib.metadata import entry_points

    return tuple(entry_points(group=group))


def _names(path: Path, group: str) -> bool:
    """Whether a package that is installed in a folder has entry points of this group."""
    section = f"[{group}]".encode()
    try:
        found = [each for each in path.iterdir() if each.name.endswith((".dist-info", ".egg-info"))]
    except OSError:  # no folder
        return path.is_file()  # an archive: importlib.metadata reads it
    for each in found:
        with contextlib.suppress(OSError):  # it may have none
            if section in (each / "entry_points.txt").read_bytes():
                return True
    return False
