"""The networks of ``camera_skeleton``, which ``make setup`` fetches; tests that need them are skipped without."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

from body_tracking.camera.model_files import default_folder
from body_tracking.camera.pose_model import DETECTOR_FILE, LANDMARKS_FILE

FOLDER = default_folder()
MISSING = [name for name in (DETECTOR_FILE, LANDMARKS_FILE) if not (FOLDER / name).is_file()]
if importlib.util.find_spec("ai_edge_litert") is None:
    MISSING.append("ai-edge-litert")
REASON = f"absent: {', '.join(MISSING)} (pip install ai-edge-litert; body_tracking camera model)"


NODES = ("camera_skeleton", "camera_rig")


def startable(executables: Sequence[str]) -> tuple[str, ...]:
    """The nodes that can start here; without the networks two are missing."""
    return tuple(name for name in executables if not MISSING or name not in NODES)
