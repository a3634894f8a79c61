"""The recordings of a folder, and those that come with the package."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import body_tracking
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, IMU
from body_tracking.core.parameters import Value

SETUPS: Final[Mapping[str, Mapping[str, Value]]] = {
    "cameras_turning": {"camera_rig": "config/camera_rig", "compressed": "colour"},
    "markers_arm": {"marker_setup": "config/marker_setup", "sensors": ()},
    "mesh_reaching": {"depth": ("kinect1",)},
}
"""Options of ``up`` for those shipped recordings whose topics do not determine them."""

_CAMERAS = "--camera, --camera-rig, --depth or --marker-setup"
TAKEN_BY: Final[Mapping[str, str]] = {IMAGE: _CAMERAS, COMPRESSED_IMAGE: _CAMERAS, IMU: "--imus"}
"""The options of ``up`` and ``replay``, by the types of topics whose names do not say which system takes them."""


def options_for_types(types: Iterable[str]) -> str:
    """What to give for a recording of these types without skeletons; empty if nothing takes them."""
    options = sorted({TAKEN_BY[each] for each in types if each in TAKEN_BY})
    return f"give up or replay the option that takes them: {', '.join(options)}" if options else ""


def is_bag(path: Path) -> bool:
    """Whether this is a rosbag2 folder, or a single mcap file."""
    return path.suffix == ".mcap" or (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))


def bags_in(folder: Path) -> tuple[Path, ...]:
    """The folder itself if it is a recording; else those in it and in its folder ``bags``, newest first."""
    try:
        if is_bag(folder):
            return (folder,)
        found = [each for place in (folder, folder / "bags") if place.is_dir() for each in place.iterdir()]
        found = [each for each in found if is_bag(each)]
        return tuple(sorted(found, key=lambda each: (-each.stat().st_mtime, each.name)))
    except OSError:  # no permission to read a folder, or a bag was deleted meanwhile
        return ()


def shipped_bags() -> tuple[Path, ...]:
    """The recordings of the repository or of the installed package."""
    found = _shipped()
    return () if found is None else tuple(sorted(filter(is_bag, (found / "bags").iterdir()), key=_rank))


def shipped_setup(bag: Path) -> Mapping[str, Value]:
    """Options of ``up`` that a shipped recording needs; none for other recordings."""
    found = _shipped()
    if found is None or bag.resolve().parent != (found / "bags").resolve():
        return {}
    own = SETUPS.get(bag.name, {})
    return {name: str(found / each) if isinstance(each, str) and "/" in each else each for name, each in own.items()}


def _shipped() -> Path | None:
    """The folder with ``bags`` and ``config``."""
    beside = Path(body_tracking.__file__).parents[1]
    places = (beside, *(each / "share" / "body_tracking" for each in (Path(sys.prefix), *beside.parents)))
    return next((place for place in places if (place / "bags").is_dir()), None)


def _rank(bag: Path) -> tuple[bool, str]:
    """Sort key: recordings of skeletons first, which need no options."""
    return not bag.name.startswith("tpose"), bag.name
