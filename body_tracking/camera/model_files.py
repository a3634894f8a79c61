"""Folder of the networks, and their download."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path, PurePosixPath
from typing import Final

from body_tracking.camera.pose_model import DETECTOR_FILE, LANDMARKS_FILE, PoseModelError
from body_tracking.core.files import user_cache

FOLDER_VARIABLE: Final = "BODY_TRACKING_POSE_MODEL"
"""Environment variable with the folder of the networks."""
_WHEEL: Final = "mediapipe==0.10.21"
"""The last release of MediaPipe with the networks inside."""
_DIGESTS: Final = {
    DETECTOR_FILE: "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
    LANDMARKS_FILE: "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
}
"""SHA-256 of the networks in it."""
_BUILT_FOR: Final = ("--python-version", "3.12", "--platform", "manylinux_2_28_x86_64")
"""One of its wheels; the networks are the same in all of them."""
_LARGEST: Final = 64 << 20
"""Bytes: greatest size of a file in it that is read."""


def default_folder() -> Path:
    """The folder of :data:`FOLDER_VARIABLE`, else one in the user's cache (XDG base directories)."""
    given = os.environ.get(FOLDER_VARIABLE)
    return Path(given).expanduser() if given else user_cache() / "pose_model"


def are_whole(folder: Path) -> bool:
    """Whether a folder has the networks, complete and of the release that :func:`fetch` downloads."""
    try:
        return all(
            hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest for name, digest in _DIGESTS.items()
        )
    except OSError:
        return False


def fetch(folder: Path) -> None:
    """Download MediaPipe's wheel with pip, and write its networks into a folder.

    Raises:
        PoseModelError: pip fails, the wheel has no such files, or the folder cannot be written.
    """
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += ["--only-binary", ":all:", *_BUILT_FOR, "--dest", scratch, _WHEEL]
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
        wheels = list(Path(scratch).glob("*.whl"))
        if done.returncode or not wheels:
            reason = done.stderr.strip().splitlines()
            raise PoseModelError(f"pip download {_WHEEL}: {reason[-1] if reason else 'no wheel'}")
        unpack(wheels[0], folder)


def unpack(wheel: Path, folder: Path) -> None:
    """Write the networks of a wheel into a folder; errors as of :func:`fetch`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(wheel) as archive:
            entries = {PurePosixPath(entry.filename).name: entry for entry in archive.infolist()}
            for name in (DETECTOR_FILE, LANDMARKS_FILE):
                if name not in entries or entries[name].file_size > _LARGEST:
                    raise PoseModelError(f"{wheel.name}: no {name}")
                partial = folder / f"{name}.partial"
                partial.write_bytes(archive.read(entries[name]))
                partial.replace(folder / name)
    except (OSError, zipfile.BadZipFile) as error:
        raise PoseModelError(f"{folder}: {error}") from error
