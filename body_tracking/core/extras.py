"""Libraries that only parts of the package need (the extras of ``setup.py``), and the command that installs them."""

from __future__ import annotations

from typing import Final

REQUIREMENTS: Final = {
    "ros": (
        "ros-jazzy-rclpy==7.1.6",
        "ros-jazzy-common-interfaces==5.3.6",
        "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
    ),
    "viewer": ("viser>=1.1,<2", "trimesh>=3.21.7", "websockets>=14"),
    "c3d": ("ezc3d>=1.7",),
}
"""By extra; equal to those of ``setup.py``."""


def pip_install(extra: str) -> str:
    """The command that installs an extra's libraries; it works beside a clone and beside an installed wheel."""
    return f"pip install {' '.join(repr(requirement) for requirement in REQUIREMENTS[extra])}"
