"""A recording of the marker system as a reference: poses of targets, and the segment of each target."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.core import files, so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.evaluation.hand_eye import Mounting, Track
from body_tracking.evaluation.reading import AngleSeries, EvaluationError, bodies, read_angles
from body_tracking.markers import setup
from body_tracking.markers.codecs import PoseOfTarget
from body_tracking.markers.messages import POSE
from body_tracking.messages.base import MessageError
from body_tracking.pipeline import graph
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader

_TOPIC: Final = re.compile(r"/markers/(\w+)/pose")
_OTHER_NAMES: Final = {"shoulder": "clavicle", "chest": "upper_trunk", "thorax": "upper_trunk"}
"""Segments of targets with these names."""
_LEAST_TARGETS: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class MarkerReference:
    """Recording of the marker system of targets on a person.

    Attributes:
        source: the bag or file.
        first_ns: stamp of the tracks' time zero, nanoseconds.
        tracks: by target, its orientation in the rig, with the covariance by the noise of the images.
        segments: by target, its segment.
        angles: of the chain of targets; None if there are none.
        warnings: one per line.
    """

    source: Path
    first_ns: int
    tracks: Mapping[str, Track]
    segments: Mapping[str, str]
    angles: AngleSeries | None
    warnings: tuple[str, ...]

    @property
    def angle_stddev(self) -> float:
        """Median of the stated standard deviations of the chain's angles, with calibration, radians; NaN if none."""
        if self.angles is None:
            return float("nan")
        known = self.angles.stddev[np.isfinite(self.angles.stddev)]
        return float(np.median(known)) if len(known) else float("nan")


def has_targets(bag: BagReader) -> bool:
    """Whether a recording has poses of targets."""
    return bool(_targets(bag))


def is_marker_reference(bag: BagReader) -> bool:
    """Whether a recording has poses of targets and no ground truth."""
    return has_targets(bag) and graph.TRUE_SKELETON not in bag.topics


def _targets(bag: BagReader) -> tuple[str, ...]:
    return tuple(
        match[1]
        for topic, info in sorted(bag.topics.items())
        if info.type_name == POSE and info.count and (match := _TOPIC.fullmatch(topic))
    )


def _plain(name: str) -> str:
    """A name in lower case without underscores and without words for 'target'."""
    return re.sub(r"(_|target|markers?)", "", name.lower())


def segment_of(name: str) -> str | None:
    """The segment of that name in any style (``UpperArmRight``, ``upper_arm_right``); None if there is none."""
    return next((segment for segment in SEGMENTS if _plain(segment) == _plain(name)), None)


def mounted_on(targets: Iterable[str], mounted: Iterable[str]) -> dict[str, str]:
    """The segment of each target.

    Args:
        targets: their names.
        mounted: ``TARGET=SEGMENT`` each; other targets are on the segment of their own name, if there is one.

    Raises:
        EvaluationError: another format, an unknown target or segment, two targets on one segment, or fewer than two
            targets on segments.
    """
    there = tuple(targets)
    given = {}
    for entry in mounted:
        target, equals, name = entry.partition("=")
        segment = segment_of(name)
        if not equals or segment is None:
            raise EvaluationError(f"--mounted {entry}: expected TARGET=SEGMENT, segments: {', '.join(SEGMENTS)}")
        if target not in there:
            raise EvaluationError(f"--mounted {entry}: no such target; there are {', '.join(there)}")
        given[target] = segment
    found = {}
    for target in there:
        plain = _plain(target)
        alias = next((plain.replace(word, other) for word, other in _OTHER_NAMES.items() if word in plain), plain)
        segment = given.get(target) or segment_of(alias)
        if segment is not None:
            found[target] = segment
    for segment in set(found.values()):
        both = [target for target, other in found.items() if other == segment]
        if len(both) > 1:
            raise EvaluationError(f"targets {' and '.join(both)} are both mounted on {segment}; see --mounted")
    if len(found) < _LEAST_TARGETS:
        without = ", ".join(target for target in there if target not in found) or "none"
        raise EvaluationError(
            f"{len(found)} of the targets {', '.join(there)} is on a known segment, {_LEAST_TARGETS} are needed; tell "
            f"where the others are ({without}) by --mounted TARGET=SEGMENT, such as --mounted {there[0]}=upper_arm_left"
        )
    return found


def read_marker_reference(path: Path, mounted: Iterable[str] = ()) -> MarkerReference:
    """Read the targets in a recording of the marker system.

    Args:
        path: a bag folder or an mcap file.
        mounted: as in :func:`mounted_on`.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: no poses of targets, unreadable ones, or as :func:`mounted_on`.
    """
    with RigReader(path) as bag:
        names = _targets(bag)
        if not names:
            raise EvaluationError(f"{path}: holds no poses of targets (/markers/<target>/pose)")
        segments = mounted_on(names, mounted)
        warnings = list(bag.warnings)
        warnings += [
            f"{path}: target {name} is on no segment that is known, and left out; see --mounted"
            for name in names
            if name not in segments
        ]
        poses: dict[str, dict[int, tuple[FloatArray, FloatArray]]] = {}
        for name in segments:
            codec, malformed = PoseOfTarget(name), 0
            for raw in bag.messages([setup.pose_topic(name)]):
                try:
                    pose = codec.decode(raw.cdr, BAG_WIRE)
                except MessageError:
                    malformed += 1
                    continue
                poses.setdefault(name, {})[pose.stamp_ns] = pose.rotation, pose.covariance[3:, 3:]
            if malformed:
                warnings.append(f"{path}: {malformed} malformed poses of {name} are left out")
            if len(poses.get(name, {})) < 2:
                raise EvaluationError(f"{path}: no two poses of target {name} can be read")
        angles = read_angles(bag, setup.BODY)[1] if setup.BODY in bodies(bag) else None
    if angles is None:
        warnings.append(
            f"{path}: holds no angles of the targets' chain: the reference's deviation is by its poses alone, without "
            "the calibration of the cameras"
        )
    first_ns = min(min(stamps) for stamps in poses.values())
    return MarkerReference(
        path,
        first_ns,
        {name: _track(each, first_ns) for name, each in poses.items()},
        segments,
        angles,
        tuple(warnings),
    )


def _track(poses: Mapping[int, tuple[FloatArray, FloatArray]], first_ns: int) -> Track:
    stamps = sorted(poses)
    return Track(
        (np.array(stamps, dtype=np.int64) - first_ns) / NANOSECONDS,
        np.stack([poses[stamp][0] for stamp in stamps]),
        np.stack([poses[stamp][1] for stamp in stamps]),
    )


# --- files of mountings


def save_mountings(path: Path, mountings: Mapping[str, Mounting], segments: Mapping[str, str]) -> None:
    """Write mountings as YAML, for other recordings with these targets mounted unchanged on the person.

    Raises:
        FileError: the file cannot be written.
    """
    lines = ["# orientation of targets on segments: quaternion x, y, z, w (target to segment), covariance in rad2\n"]
    for target, mounting in mountings.items():
        quat = ", ".join(f"{value:.9f}" for value in so3.matrix_to_quat(mounting.rotation))
        covariance = ", ".join(f"{value:.6g}" for value in mounting.covariance.reshape(-1))
        lines.append(f"{target}:\n  segment: {segments[target]}\n  quat_xyzw: [{quat}]\n  covariance: [{covariance}]\n")
    files.write_text(path, "".join(lines))


def load_mountings(path: Path, segments: Mapping[str, str]) -> dict[str, Mounting]:
    """The inverse of :func:`save_mountings`.

    Args:
        path: the file.
        segments: by target in use; other targets in the file are ignored.

    Raises:
        EvaluationError: the file is unreadable, of another format, or has a target on another segment.
    """
    content = files.read_yaml(path, error=EvaluationError)
    if not isinstance(content, dict):
        raise EvaluationError(f"{path}: no mapping of targets to mountings")
    found = {}
    for target, segment in segments.items():
        if target in content:
            found[target] = _mounting(path, target, segment, content[target])
    if not found:
        raise EvaluationError(f"{path}: holds no mounting of {', '.join(segments)}")
    return found


def _mounting(path: Path, target: str, segment: str, entry: Any) -> Mounting:
    try:
        quat = np.array(entry["quat_xyzw"], dtype=np.float64).reshape(4)
        covariance = np.array(entry["covariance"], dtype=np.float64).reshape(3, 3)
        on = str(entry["segment"])
    except (KeyError, TypeError, ValueError) as error:
        raise EvaluationError(
            f"{path}: {target}: expected segment, quat_xyzw of 4 and covariance of 9 numbers"
        ) from error
    if on != segment:
        raise EvaluationError(f"{path}: {target} is on {on} there, and on {segment} here")
    symmetric = np.isfinite(covariance).all() and np.allclose(covariance, covariance.T, rtol=1e-4, atol=1e-12)
    if not symmetric or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise EvaluationError(f"{path}: {target}: the covariance is not positive definite")
    if not abs(np.linalg.norm(quat) - 1.0) < 1e-3:
        raise EvaluationError(f"{path}: {target}: a quaternion of length {np.linalg.norm(quat):.3g}")
    return Mounting(so3.quat_to_matrix(quat / np.linalg.norm(quat)), 0.5 * (covariance + covariance.T))
