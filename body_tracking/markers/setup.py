"""Folder with the marker nodes' files ``rig.yaml``, ``targets.yaml`` and ``chain.yaml``; names of topics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError

RIG, TARGETS, CHAIN = "rig.yaml", "targets.yaml", "chain.yaml"
POINTS: Final = "/markers/points"
BODY: Final = "markers"
"""The id under which angles of a chain of targets are published."""
_FRAME_SUFFIX: Final = "_optical_frame"


class SetupError(BodyTrackingError):
    """Raised when no folder is given or it lacks a file."""


def file_of(folder: object, name: str, made_by: str, else_do: str = "") -> Path:
    """A file of the folder.

    Args:
        folder: the parameter ``setup``.
        name: one of the three.
        made_by: the command that writes it, for the error message.
        else_do: end of the message: how to do without the file.

    Raises:
        SetupError: no folder, or no such file in it.
    """
    if not folder:
        raise SetupError(f"setup: no folder given; it has to hold {name}")
    path = Path(str(folder)).expanduser() / name
    if not path.is_file():
        raise SetupError(f"{path}: no such file; body_tracking markers {made_by} makes it{else_do}")
    return path


def camera_names(folder: Path) -> tuple[str, ...]:
    """The names of the cameras of a setup's rig, without parsing the rest of it.

    Raises:
        SetupError: no folder, or no such file in it, or it names no cameras.
    """
    path = file_of(folder, RIG, "calibrate", "; without cameras, --marker-points names the topic of the points")
    try:
        return tuple(camera_name(str(each["frame"])) for each in files.read_yaml(path)["cameras"])
    except files.FileError as error:
        raise SetupError(f"{path}: {error}") from error
    except (KeyError, TypeError) as error:
        raise SetupError(f"{path}: lists no cameras") from error


def camera_name(frame_id: str) -> str:
    """The name of a camera in topics, from its optical frame."""
    return frame_id.removesuffix(_FRAME_SUFFIX)


def image_topic(camera: str) -> str:
    """The topic of a camera's images, by its frame or name."""
    return f"/{camera_name(camera)}/image_raw"


def info_topic(camera: str) -> str:
    """The topic of a camera's calibration."""
    return f"/{camera_name(camera)}/camera_info"


def balls_topic(camera: str) -> str:
    """The topic of the balls in a camera's images."""
    return f"/{camera_name(camera)}/balls"


def pose_topic(target: str) -> str:
    """The topic of a target's poses."""
    return f"/markers/{target}/pose"


def sources(cameras: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Alternative sets of topics that the other data can be computed from: images, balls, or points."""
    return tuple(map(image_topic, cameras)), tuple(map(balls_topic, cameras)), (POINTS,)


def sources_in(folder: Path) -> tuple[tuple[str, ...], ...]:
    """:func:`sources` of a setup.

    Without a rig, only points, which then come from another motion capture system.

    Raises:
        SetupError: no such folder, or as :func:`camera_names`.
    """
    if not folder.expanduser().is_dir():
        reason = "a file, expected its folder" if folder.expanduser().exists() else "no such folder"
        raise SetupError(f"{folder}: {reason}")
    if not any((folder.expanduser() / each).is_file() for each in (RIG, TARGETS)):
        raise SetupError(f"{folder}: holds neither {RIG} nor {TARGETS}, so it is no marker setup")
    if not (folder.expanduser() / RIG).is_file():
        return ((POINTS,),)
    return sources(camera_names(folder))
