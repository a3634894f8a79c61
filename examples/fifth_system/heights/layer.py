"""Its layer in the viewer's scene."""

from __future__ import annotations

from typing import Any


def draw(scene: Any, path: str, payload: tuple[int, float] | None) -> None:
    """Draw a label with the height."""
    text = "" if payload is None else f"{payload[1]:.2f} m"
    scene.add_label(path, text, position=(0.0, 0.0, 1.0), visible=payload is not None)
