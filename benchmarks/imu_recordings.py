"""Clocks, alignment and angles of inertial sensors in two real recordings.

two_arm_imus: two sensors on one arm, with clocks 11.03 s apart. The clock offset is found from the motion alone. The
sensors are then aligned at the first instants, which are the T-pose; the figures are the angles between the upper arm's
direction and that pose each time that it passes through it. The arm never stops, so that the person's own deviations
are included.

xsens_upper_body: ISB angles of the segments of an Xsens MVN suit from its sensors' orientations, against the joint
angles in the file. Its own conventions, all taken from the file: its segments are zero in the T-pose (frame "tpose")
and its joints in "tpose-isb", so that a constant rotation leads from one to the other, and a quarter turn of pronation
to ours; the shoulder is stated against the clavicle (jT4Shoulder) and in ZXY, so that both joints are combined and
expressed as YXY against the thorax; and abduction is positive on both sides, so that x has the opposite sign on the
right, y on the left. The file has no sensor orientation in the T-pose: MVN's alignment is recovered from the first half
second; the figures are of the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.imu import ImuSample
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.inertial.alignment import Stream, align_in_pose, pose_covariance, pose_rotations, still_periods
from body_tracking.inertial.clock import clock_offset, turning_of_sensor
from body_tracking.inertial.imu_csv import ImuCsvRecording
from body_tracking.inertial.mvnx import MvnxFrame, MvnxRecording
from body_tracking.kinematics.conventions import convention
from body_tracking.kinematics.upper_body import UpperBody

MODEL = UpperBody()
CLOCK_BAR_S, RETURN_BAR_DEG, ANGLE_BAR_DEG = 0.020, 5.0, 3.0

# ---------------------------------------------------------------------------------------------------------------------
# two_arm_imus

TWO_ARM = "two_arm_imus/data8_onArmAbductionFromTposeAndBack.csv.gz"
TRUE_OFFSET_S = 11.03


def read_two_arm(path: Path) -> tuple[Stream, Stream]:
    """Both sensors, each in its own clock."""
    segments = ("upper_arm_right", "forearm_right")
    samples: dict[str, list[ImuSample]] = {segment: [] for segment in segments}
    for reading in ImuCsvRecording(path, segments):
        samples[reading.sensor].append(reading.sample)
    upper, lower = (
        Stream(
            segment,
            np.array([sample.stamp_ns for sample in own]) / NANOSECONDS,
            so3.quat_to_matrix(np.array([sample.orientation for sample in own])),
            np.array([sample.angular_velocity for sample in own]),
        )
        for segment, own in samples.items()
    )
    return upper, lower


def two_arm(path: Path) -> dict[str, Any]:
    """Figures of the clock and of the returns to the T-pose."""
    upper, lower = read_two_arm(path)
    found = clock_offset(turning_of_sensor(upper.stamps, upper.rates), turning_of_sensor(lower.stamps, lower.rates))
    figures: dict[str, Any] = {"clock_found": found is not None}
    if found is None:
        return figures
    figures |= {
        "offset_s": found.offset,
        "offset_error_s": found.offset - TRUE_OFFSET_S,
        "offset_stddev_s": found.stddev,
        "drift_ppm": found.drift_ppm,
        "drift_stddev_ppm": found.drift_stddev_ppm,
    }
    stamps = [found.to_reference(round(stamp * NANOSECONDS)) / NANOSECONDS for stamp in lower.stamps.tolist()]
    streams = (upper, Stream(lower.segment, np.array(stamps), lower.rotations, lower.rates))
    figures["still_periods"] = len(still_periods(streams))
    segments = [stream.segment for stream in streams]
    begin = max(stream.stamps[0] for stream in streams)
    pose = pose_rotations(MODEL, "t")[[SEGMENTS.index(name) for name in segments]]
    measured = np.array([so3.mean_rotation(stream.between(begin, begin + 0.1).rotations) for stream in streams])
    # the mounting is unknown; with magnetometers, any common heading, and 10 degrees for each sensor
    headings = np.pi**2 / 3.0 + np.radians(10.0) ** 2 * np.eye(2)
    alignment = align_in_pose(
        segments,
        measured,
        pose,
        pose_covariance(MODEL, "t", segments),
        headings=np.zeros(2),
        heading_covariance=headings,
    )
    for number, stream in enumerate(streams):
        world = alignment.oriented(number, stream.rotations)
        along = -world[:, :, 2]
        # azimuth from the T-pose: the right arm points to -y there
        azimuth = np.arctan2(along[:, 0], -along[:, 1])
        back = np.flatnonzero((azimuth[:-1] * azimuth[1:] <= 0.0) & (np.abs(azimuth[:-1]) < 1.0))
        back = back[stream.stamps[back] > begin + 1.0]
        off = np.degrees(np.arccos(np.clip(along[back] @ -pose[number, :, 2], -1.0, 1.0)))
        figures[stream.segment] = {
            "range_deg": [float(np.degrees(azimuth.min())), float(np.degrees(azimuth.max()))],
            "passages": len(off),
            "median_deg": float(np.median(off)),
            "last_deg": float(off[-1]),
            "worst_deg": float(off.max()),
        }
    return figures


# ---------------------------------------------------------------------------------------------------------------------
# xsens_upper_body

XSENS = "xsens_upper_body/test_mocap.mvnx.gz"
XSENS_SEGMENTS = {"pelvis": "Pelvis", "upper_trunk": "T8", "head": "Head"} | {
    f"{ours}_{side}": side.title() + theirs
    for side in ("left", "right")
    for ours, theirs in (("clavicle", "Shoulder"), ("upper_arm", "UpperArm"), ("forearm", "ForeArm"), ("hand", "Hand"))
}
ALIGNED_FRAMES = 30


def read_xsens(path: Path) -> dict[str, Any]:
    """By name, rotations of segments and sensors and angles of all frames, and segments in the poses before them."""
    recording = MvnxRecording(path)
    frames: dict[str, list[MvnxFrame]] = {}
    for frame in recording.frames():
        frames.setdefault(frame.kind, []).append(frame)
    header = recording.header
    assert header is not None

    def rotations(kind: str, what: str, names: Sequence[str]) -> dict[str, FloatArray]:
        turned = so3.quat_to_matrix(np.array([getattr(frame, what) for frame in frames[kind]]))
        return {name: turned[:, number] for number, name in enumerate(names)}

    angles = np.array([frame.joint_angles for frame in frames["normal"]])
    return {
        "segments": rotations("normal", "segment_xyzw", header.segments),
        "sensors": rotations("normal", "sensor_xyzw", header.sensors),
        "tpose": {name: each[0] for name, each in rotations("tpose", "segment_xyzw", header.segments).items()},
        "isb": {name: each[0] for name, each in rotations("tpose-isb", "segment_xyzw", header.segments).items()},
        "angles": {name: angles[:, number] for number, name in enumerate(header.joints)},
    }


def to_ours(data: dict[str, Any], segment: str) -> FloatArray:
    """(3, 3) rotation from the file's frame of a segment to ours: T-pose frame, ISB frame, pronation."""
    name = XSENS_SEGMENTS[segment]
    constant = data["tpose"][name].T @ data["isb"][name]
    if segment.startswith(("forearm", "hand")):  # ISB's zero has the palm forward, ours the thumb
        turn = -0.5 * np.pi if segment.endswith("right") else 0.5 * np.pi
        constant = constant @ so3.quat_to_matrix(so3.exp(np.array([0.0, 0.0, turn])))
    return np.asarray(constant)


def stated_rotation(data: dict[str, Any], joint: str) -> FloatArray:
    """(n, 3, 3) a joint's rotation in ISB axes, from the file's angles: about z, then x, then y."""
    x, y, z = data["angles"][joint].T
    x, y = (-x, y) if "Right" in joint else (x, -y)
    return Rotation.from_euler("ZXY", np.stack([z, x, y], axis=-1)).as_matrix()


def stated_angles(data: dict[str, Any], side: str) -> dict[str, FloatArray]:
    """(n,) the file's angles by the names of our convention ``isb``, radians."""
    title = side.title()
    elbow = data["angles"][f"j{title}Elbow"]
    # both joints of the shoulder together, mirrored on the left as ISB prescribes
    humerus = stated_rotation(data, f"j{title}T4Shoulder") @ stated_rotation(data, f"j{title}Shoulder")
    if side == "left":
        mirror = np.diag([1.0, 1.0, -1.0])
        humerus = mirror @ humerus @ mirror
    plane, elevation, rotation = Rotation.from_matrix(humerus).as_euler("YXY").T
    # choose the solution with a negative elevation
    flip = np.where(elevation > 0.0, np.pi, 0.0)
    return {
        f"elbow_flexion_{side}": elbow[:, 2],
        f"elbow_pronation_{side}": elbow[:, 1],
        f"shoulder_plane_of_elevation_{side}": plane + flip,
        f"shoulder_elevation_{side}": -np.abs(elevation),
        f"shoulder_internal_rotation_{side}": rotation - flip,
    }


def isb_angles(rotations: FloatArray) -> tuple[FloatArray, list[str]]:
    """(n, 3 c) angles of the c chains of convention ``isb`` over (n, 12, 3, 3), continuous, rad; names or ``""``."""
    isb = convention("isb", MODEL)
    ((sequences, parents, children, rows),) = isb.stages
    place = {row - rows.start: name for row, name in zip(isb.rows.tolist(), isb.names, strict=True)}
    relative = np.nan_to_num(rotations[:, parents].swapaxes(-1, -2) @ rotations[:, children])
    found: list[FloatArray] = []
    for each in relative:
        previous = found[-1].reshape(-1, 3) if found else None
        found.append(sequences.split(each, np.zeros((len(each), 3)), previous).angles.reshape(-1))
    return np.array(found), [place.get(number, "") for number in range(rows.stop - rows.start)]


def xsens(path: Path) -> dict[str, Any]:
    """RMS differences of each angle between sensors and file, degrees."""
    data = read_xsens(path)
    count = len(data["sensors"]["Pelvis"])
    theirs, ours = np.full((2, count, 12, 3, 3), np.nan)
    pose = pose_rotations(MODEL, "t")
    tpose, rigid = {}, {}
    for segment, name in XSENS_SEGMENTS.items():
        number, constant = SEGMENTS.index(segment), to_ours(data, segment)
        theirs[:, number] = data["segments"][name] @ constant
        tpose[segment] = float(
            np.degrees(np.linalg.norm(so3.rotation_vectors(pose[number].T @ data["tpose"][name] @ constant)))
        )
        sensor = data["sensors"][name]
        alignment = so3.mean_rotation(sensor[:ALIGNED_FRAMES].swapaxes(-1, -2) @ theirs[:ALIGNED_FRAMES, number])
        ours[:, number] = sensor @ alignment
        off = so3.rotation_vectors(theirs[:, number].swapaxes(-1, -2) @ ours[:, number])
        rigid[segment] = float(np.degrees(np.sqrt((off[ALIGNED_FRAMES:] ** 2).sum(axis=1).mean())))
    (from_sensors, names), (from_segments, _) = isb_angles(ours), isb_angles(theirs)
    figures: dict[str, Any] = {"frames": count - ALIGNED_FRAMES, "sensor_to_segment_deg": rigid, "tpose_deg": tpose}
    for side in ("left", "right"):
        for name, stated in stated_angles(data, side).items():
            column = names.index(name)
            off, exact = (wrapped(each[:, column] - stated) for each in (from_sensors, from_segments))
            judged = np.degrees(off[ALIGNED_FRAMES:])
            figures[name] = {
                "rms_deg": float(np.sqrt((judged**2).mean())),
                "bias_deg": float(judged.mean()),
                "worst_deg": float(np.abs(judged).max()),
                "convention_deg": float(np.degrees(np.abs(exact).max())),
            }
    return figures


def angles_in(figures: dict[str, Any]) -> dict[str, dict[str, float]]:
    """The angles among the figures of the suit."""
    return {name: row for name, row in figures.items() if isinstance(row, dict) and "rms_deg" in row}


def bars(two: dict[str, Any], suit: dict[str, Any]) -> dict[str, bool]:
    """Whether each bar is met."""
    met = {"clock offset": two["clock_found"] and abs(two["offset_error_s"]) <= CLOCK_BAR_S}
    if two["clock_found"]:
        row = two["upper_arm_right"]
        met["abduction and back"] = max(row["median_deg"], row["last_deg"]) <= RETURN_BAR_DEG
    return met | {name: row["rms_deg"] <= ANGLE_BAR_DEG for name, row in angles_in(suit).items()}


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed, 2 where the recordings are absent."""
    args = common.parser(__doc__, data=True).parse_args()
    two_arm_file, xsens_file = common.recordings(args.data / "imu", [TWO_ARM, XSENS])
    two, suit = two_arm(two_arm_file), xsens(xsens_file)
    common.report(args, {"two_arm_imus": two, "xsens_upper_body": suit})
    return common.verdicts(args, bars(two, suit))


if __name__ == "__main__":
    sys.exit(main())
