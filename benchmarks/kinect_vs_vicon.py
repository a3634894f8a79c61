"""A real Kinect v2 against Vicon: arm elevation and elbow flexion, raw and filtered, in degrees.

The clips are exercises of the right arm of five people (UI-PRMD, Vakanski et al. 2018), each recorded by both systems.
Filters run with and without the correction of a Kinect's arms and spine (``calibration.arm_directions``,
``calibration.kinect_spine``). The law of the arms is fitted without the subject on whom it is evaluated; ``--fit``
prints the law of all subjects, which is the shipped one. The table holds the median over subjects of their clips'
medians, and its ratio to that of the raw skeleton. stddev is the median of the published standard deviations (linear
filters: positional angles; ``ekf``: convention ``isb``). Coverage is the share of all frames of a subject with an error
within 1.96 of it, mean over subjects. (The coverage of the median clip, in the last column, does not measure it: errors
persist throughout a clip, so that the median clip has all of its frames inside although 95 % of the frames of all clips
are.) The linear filters' standard deviations depend on the correlation of neighbouring joints' errors
(``core.measurement``), which is also fitted without that subject; ``ekf`` has the shipped one. Rate is the RMS of the
angle error's time derivative, degrees per second; ``--lag`` adds rows with smoothing (``filters.smoothing``). Clips
whose time warp explains less than 0.9 are left out. Last, for the rows of ``ekf``, the flexion of the trunk against the
pelvis (convention ``model``) of these people, who stand upright: the median over the second halves of a subject's
clips. And how much of the motion of the right shoulder along the trunk axis each method shows (by Vicon 11 mm RMS in a
clip): the slope of its height above SpineShoulder by that above the middle of C7 and CLAV, of all clips without their
means (1 is ideal).

Angles. Elevation: upper arm against the trunk axis, 0 hanging; flexion: forearm against upper arm, 0 straight. Plane of
elevation and rotation of the upper arm as in ``kinematics.positional``, compared where they exist: the arm raised by 30
to 150 degrees by Vicon, for the rotation also the elbow bent by 40 or more (nearly all in the clips of m09). Kinect:
the lines between the joints, trunk axis from SpineMid to SpineShoulder. Vicon: from joint centres that are computed
from the markers. The trunk axis runs from the middle of T10 and STRN to the middle of C7 and CLAV (ISB's y axis of the
thorax, Wu 2005, with T10 for T8 and STRN for the xiphoid process). The shoulder lies below the acromion along the trunk
axis (Rab 2002) by 12 % of the distance between the acromia: of all shares this one gives the smallest variation of the
upper arm's length over the raised arm (Rab's 17 %: up to 14 mm of standard deviation instead of 3). The elbow lies half
an elbow's width from its lateral marker, at a right angle to the upper arm and towards the body, along the normal of
the plane of shoulder, elbow marker and wrist (Plug-in Gait's chord function). The wrist is the middle of WRA and WRB.

Time. Neither system recorded stamps, and the clips were cut separately, so a smooth warp of six parameters is estimated
(``time_warp``) from the directions of upper arm and forearm in the thorax's axes. Each clip has one warp, estimated
from all methods but the smoothed ones together: all methods are compared over the same frames, none has an advantage,
and a lag counts as an error. The law is fitted with the warp of the raw skeleton alone.
"""

from __future__ import annotations

import csv
import gzip
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import common
import numpy as np
from scipy.optimize import brentq
from time_warp import TimeWarp, compare, estimate_warp

from body_tracking.calibration.arm_directions import ArmLaw, corrected_arms
from body_tracking.calibration.kinect_spine import corrected_kinect
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.measurement import joint_stddev
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.evaluation.metrics import sample
from body_tracking.filters import DEFAULT_FILTER, ModelFilter, SkeletonFilter, make_filter
from body_tracking.filters.smoothing import FixedLag, SmoothableFilter
from body_tracking.kinect.axes import camera_space_to_optical
from body_tracking.kinematics.conventions import angles_of
from body_tracking.kinematics.positional import positional_angles

KINECT_RATE, VICON_RATE = 30.0, 100.0
"""Nominal frame rates, Hz."""

PERIODIC = ("m09",)
"""Clips of rotation of the raised arm: the Kinect's begins with the forearm up, Vicon's half a cycle apart, forward."""

ACROMION_TO_SHOULDER = 0.12
"""Distance of the shoulder centre below the acromion marker, as a share of the distance between the acromia."""
HALF_ELBOW = 0.040
"""Distance of the elbow centre from its lateral marker's centre, m: half the width of an adult's elbow and marker."""

ANGLES = ("elevation", "flexion")
PARTIAL = ("plane", "rotation")
"""Angles that exist in some poses only."""
RAISED, BENT = (30.0, 150.0), 40.0
"""Elevation, and least flexion for the rotation, degrees, between and beyond which they are compared."""
LEAST_SAMPLES = 20
"""Of a clip in which such an angle exists, to be compared."""
_NAMES = ("shoulder_elevation_right", "elbow_flexion_right", "shoulder_plane_right", "humeral_rotation_right")
_ISB_NAMES = (*_NAMES[:2], "shoulder_plane_of_elevation_right", "shoulder_internal_rotation_right")
"""Names of the published angles, positional and of ISB."""
_EVERY = 30
"""Every thirtieth frame is used to fit the correlation: errors of consecutive frames hardly differ."""
RAW = "raw"
Methods = dict[str, tuple[str, bool, float]]
METHODS: Methods = {
    DEFAULT_FILTER: (DEFAULT_FILTER, True, 0.0),
    "ekf": ("ekf", True, 0.0),
    f"{DEFAULT_FILTER}, no law": (DEFAULT_FILTER, False, 0.0),
    "ekf, no law": ("ekf", False, 0.0),
}
"""Filters at their default settings, from each clip's first frame on; whether with the law; the lag in s."""
HELD = (DEFAULT_FILTER, "ekf")
"""Filters to which the bars apply."""
LEAST_EXPLAINED = 0.9
LOST_MARKER = 0.1
"""Metres from the median height of Vicon's shoulder beyond which a marker is lost (the first frames of one clip)."""
BARS = {"elevation": 0.80, "flexion": 0.70}
"""Largest ratio of the median RMS to the raw skeleton's."""
WORSE = 0.5
"""Largest excess of a subject's RMS over the raw skeleton's, degrees."""
COVERAGE = (0.88, 0.99)
"""Bounds of the coverage of the 95 % bands."""

KINECT_JOINTS = {
    "waist": Joint.SPINE_BASE,
    "spine": Joint.SPINE_MID,
    "chest": Joint.SPINE_SHOULDER,
    # "neck" lies at a tenth of the way from chest to "head", as do the collars: the recording program computes them
    "head": Joint.NECK,
    "head_tip": Joint.HEAD,
    "left_upper_arm": Joint.SHOULDER_LEFT,
    "left_forearm": Joint.ELBOW_LEFT,
    "left_hand": Joint.WRIST_LEFT,
    "right_upper_arm": Joint.SHOULDER_RIGHT,
    "right_forearm": Joint.ELBOW_RIGHT,
    "right_hand": Joint.WRIST_RIGHT,
    "left_upper_leg": Joint.HIP_LEFT,
    "left_lower_leg": Joint.KNEE_LEFT,
    "left_foot": Joint.ANKLE_LEFT,
    "left_toes": Joint.FOOT_LEFT,
    "right_upper_leg": Joint.HIP_RIGHT,
    "right_lower_leg": Joint.KNEE_RIGHT,
    "right_foot": Joint.ANKLE_RIGHT,
    "right_toes": Joint.FOOT_RIGHT,
}
"""Names of the recording program (of segments, at their proximal ends), and the SDK's joints at these places."""


@dataclass(frozen=True)
class Arm:
    """The right arm over time.

    Attributes:
        times: (n,) s.
        elevation, flexion, plane, rotation: (n,) degrees.
        directions: (n, 6) unit vectors of upper arm and forearm in the thorax's axes (forward, left, up).
        height: (n,) m, of the shoulder above the thorax's upper end, along the trunk axis.
    """

    times: FloatArray
    elevation: FloatArray
    flexion: FloatArray
    plane: FloatArray
    rotation: FloatArray
    directions: FloatArray
    height: FloatArray


def read(path: Path) -> dict[str, FloatArray]:
    """Named points of a clip, (n, 3) each, metres."""
    with gzip.open(path, "rt", newline="") as stream:
        rows = csv.reader(stream)
        header = next(rows)
        values = np.array([[float(cell) for cell in row] for row in rows])
    return {name[:-2]: values[:, column : column + 3] for column, name in enumerate(header) if name.endswith("_x")}


def kinect_skeletons(path: Path) -> list[Skeleton]:
    """A clip as skeletons in world axes (z up, x along the sensor's view), with the covariances of the live graph."""
    points = read(path)
    frames = len(points["waist"])
    positions = np.full((frames, N_JOINTS, 3), np.nan)
    for name, joint in KINECT_JOINTS.items():
        positions[:, joint] = points[name]
    # the file's x points to the person's left, z towards the sensor: camera space turned by half a turn about y
    optical = camera_space_to_optical(positions * [-1.0, 1.0, -1.0])
    world = np.stack([optical[..., 2], -optical[..., 0], -optical[..., 1]], axis=-1)
    states = np.full(N_JOINTS, TrackingState.NOT_TRACKED, dtype=np.uint8)
    states[list(KINECT_JOINTS.values())] = TrackingState.TRACKED
    variances = joint_stddev(optical, np.tile(states, (frames, 1))) ** 2
    return [
        Skeleton(
            round(index * NANOSECONDS / KINECT_RATE),
            "world",
            each,
            states,
            covariances=np.where(np.eye(3) > 0.0, variance[:, None, None], 0.0),
        )
        for index, (each, variance) in enumerate(zip(world, variances, strict=True))
    ]


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def _arm(
    times: FloatArray,
    up: FloatArray,
    left: FloatArray,
    chest: FloatArray,
    shoulder: FloatArray,
    elbow: FloatArray,
    wrist: FloatArray,
) -> Arm:
    upper, forearm = elbow - shoulder, wrist - elbow
    up = _unit(up)
    left = _unit(left - (left * up).sum(axis=-1, keepdims=True) * up)
    axes = np.stack([np.cross(left, up), left, up], axis=1)
    directions = [np.einsum("nij,nj->ni", axes, _unit(each)) for each in (upper, forearm)]
    elevation, flexion = (np.degrees(common.between(upper, other)) for other in (-up, forearm))
    height = ((shoulder - chest) * up).sum(axis=-1)
    return Arm(times, elevation, flexion, *_plane_and_rotation(*directions), np.concatenate(directions, axis=1), height)


def _plane_and_rotation(upper: FloatArray, forearm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of the right arm, (n,) degrees each, from directions in the thorax's axes (forward, left, up)."""
    plane = np.arctan2(upper[:, 0], -upper[:, 1])
    ahead = _unit(np.cross([0.0, 0.0, 1.0], upper))  # the forearm's direction without rotation
    inward = np.cross(ahead, upper)
    rotation = np.arctan2((forearm * inward).sum(axis=1), (forearm * ahead).sum(axis=1))
    return np.degrees(plane), np.degrees(rotation)


def _where_it_exists(angle: str, true: FloatArray, elevation: FloatArray, flexion: FloatArray) -> FloatArray:
    """Vicon's values (n,) of a partial angle, NaN where the arm's pose does not determine it; all in degrees."""
    there = (elevation > RAISED[0]) & (elevation < RAISED[1])
    if angle == "rotation":
        there &= flexion > BENT
    return np.where(there, true, np.nan)


def kinect_arm(skeletons: list[Skeleton]) -> Arm:
    """The right arm from skeletons."""
    times = np.array([each.stamp for each in skeletons])
    p = np.stack([each.positions for each in skeletons], axis=1)
    return _arm(
        times,
        p[Joint.SPINE_SHOULDER] - p[Joint.SPINE_MID],
        p[Joint.SHOULDER_LEFT] - p[Joint.SHOULDER_RIGHT],
        p[Joint.SPINE_SHOULDER],
        p[Joint.SHOULDER_RIGHT],
        p[Joint.ELBOW_RIGHT],
        p[Joint.WRIST_RIGHT],
    )


def vicon_arm(path: Path) -> Arm:
    """The right arm from joint centres by the markers."""
    m = read(path)
    up = _unit(m["C7"] + m["CLAV"] - m["T10"] - m["STRN"])
    left = np.cross(up, m["CLAV"] + m["STRN"] - m["C7"] - m["T10"])
    acromia = np.linalg.norm(m["LSHO"] - m["RSHO"], axis=-1, keepdims=True)
    shoulder = m["RSHO"] - ACROMION_TO_SHOULDER * acromia * up
    wrist = 0.5 * (m["RWRA"] + m["RWRB"])
    upper, forearm = shoulder - m["RELB"], wrist - m["RELB"]
    medial = _unit(np.cross(upper, forearm))  # of the right arm
    length = np.linalg.norm(upper, axis=-1, keepdims=True)
    # the angle at the elbow centre between shoulder and marker is a right angle (Thales)
    sine = HALF_ELBOW / length
    elbow = m["RELB"] + HALF_ELBOW * (np.sqrt(1.0 - sine**2) * medial + sine * upper / length)
    chest = 0.5 * (m["C7"] + m["CLAV"])
    return _arm(np.arange(len(up)) / VICON_RATE, up, left, chest, shoulder, elbow, wrist)


@dataclass(frozen=True)
class Filtered:
    """The output of a filter.

    Attributes:
        skeletons: one per frame.
        published: (n, 4) published angles of the right arm: elevation, flexion, plane and rotation, degrees.
        stddev: (n, 4) their standard deviations, degrees; infinite where unknown.
        trunk: median flexion of the trunk in the second half, degrees; NaN without a body model.
    """

    skeletons: list[Skeleton]
    published: FloatArray
    stddev: FloatArray
    trunk: float


def _outputs(
    skeletons: list[Skeleton], chosen: SkeletonFilter, lag: float
) -> Iterator[tuple[Skeleton, ModelEstimate | None]]:
    """Output of a filter, smoothed with a lag in s unless it is 0."""
    if lag:
        assert isinstance(chosen, SmoothableFilter)
        held = FixedLag(chosen, lag)
    for each in skeletons:
        if (out := chosen.update(each)) is None:
            continue
        if lag:
            assert isinstance(chosen, SmoothableFilter)
            yield from map(chosen.results_of, held.take(chosen.last_frame(out), each.stamp_ns))
        else:
            yield out, chosen.estimate if isinstance(chosen, ModelFilter) else None
    if lag:
        assert isinstance(chosen, SmoothableFilter)
        yield from map(chosen.results_of, held.flush())


def filtered(skeletons: list[Skeleton], name: str, of_bones: float, lag: float = 0.0) -> Filtered:
    """Filter skeletons; ``of_bones`` as for ``positional_angles``, the lag of smoothing in s."""
    chosen = make_filter(name)
    found, angles = [], None
    published, stddev, trunk = [], [], []
    for out, estimate in _outputs(skeletons, chosen, lag):
        if isinstance(chosen, ModelFilter):
            assert estimate is not None
            angles = angles_of(estimate, chosen.model, "isb", angles)
            of_model = angles_of(estimate, chosen.model, "model")
            trunk.append(np.degrees(of_model.position[of_model.names.index("trunk_flexion")]))
        else:
            angles = positional_angles(out, of_bones)
        names = _ISB_NAMES if isinstance(chosen, ModelFilter) else _NAMES
        columns = [angles.names.index(name) for name in names]
        found.append(out)
        own = np.degrees(angles.position[columns])
        published.append([abs(own[0]), *own[1:]])  # ISB's elevation is negative
        stddev.append(np.degrees(angles.position_stddev[columns]))
    bent = float(np.median(trunk[len(trunk) // 2 :])) if trunk else float("nan")
    return Filtered(found, np.array(published), np.array(stddev), bent)


def align(arms: list[Arm], vicon: Arm, clip: str) -> TimeWarp:
    """The one warp from Kinect's times to Vicon's that fits the directions of all these arms together."""
    times = arms[0].times
    directions = np.concatenate([sample(times, arm.times, arm.directions) for arm in arms], axis=1)
    known = np.isfinite(directions).all(axis=1)
    cycle = vicon.times[-1] + 1.0 / VICON_RATE if clip.startswith(PERIODIC) else None
    return estimate_warp(
        times[known], directions[known], vicon.times, np.tile(vicon.directions, (1, len(arms))), period=cycle
    )


def lag(arm: Arm, raw: Arm) -> float:
    """Delay of the directions against the raw ones, seconds (least squares over shifts)."""
    shifts = np.arange(-0.05, 0.2, 0.001)

    def apart(shift: float) -> float:
        # compare all shifts over the same frames
        inside = (arm.times - shifts[-1] >= raw.times[0]) & (arm.times - shifts[0] <= raw.times[-1])
        there = sample(arm.times[inside] - shift, raw.times, raw.directions)
        return float(np.nanmean((arm.directions[inside] - there) ** 2))

    return float(shifts[np.argmin([apart(shift) for shift in shifts])])


@dataclass(frozen=True)
class Clip:
    """A clip of both systems, with directions at the same instants by the warp of the raw skeleton.

    Attributes:
        name: movement, subject and episode.
        folder: of the recordings.
        explained: share of the variance explained by the warp.
        kinect, vicon: (n, 2, 3) directions of upper arm and forearm.
        skeletons: (n,) of the Kinect.
        angles: (n, 2) Vicon's ``ANGLES``, degrees; NaN outside its clip.
    """

    name: str
    folder: Path
    explained: float
    kinect: FloatArray
    vicon: FloatArray
    skeletons: list[Skeleton]
    angles: FloatArray

    @property
    def subject(self) -> str:
        return self.name.split("_")[1]


def load(file: Path) -> Clip:
    """Read and align a clip's files of Kinect and Vicon."""
    name = file.name.removesuffix("_kinect.csv.gz")
    skeletons = kinect_skeletons(file)
    raw, vicon = kinect_arm(skeletons), vicon_arm(file.with_name(f"{name}_vicon.csv.gz"))
    warp = align([raw], vicon, name)
    at = warp(raw.times)
    return Clip(
        name,
        file.parent,
        warp.explained,
        raw.directions.reshape(-1, 2, 3),
        _unit(sample(at, vicon.times, vicon.directions).reshape(-1, 2, 3)),
        skeletons,
        np.stack([sample(at, vicon.times, getattr(vicon, angle)) for angle in ANGLES], axis=1),
    )


def fit_arm_law(clips: Sequence[tuple[str, FloatArray, FloatArray]], ridge: float = 0.1) -> ArmLaw:
    """Fit the coefficients of the arms' directions by ridge regression of the differences (Hoerl and Kennard 1970).

    ``W = D^T X (X^T X + r I)^-1`` with rows of ``X`` and ``D`` for each frame. All subjects have equal weights,
    likewise all clips of a subject, and the weights sum to one.

    Args:
        clips: subject, and (n, 2, 3) unit directions of upper arm and forearm, measured and anatomical, of the right
            arm in the axes of the thorax; frames with NaN are left out.
        ridge: ``r``, in units of the mean square of a direction's component times three.
    """
    subjects = [subject for subject, _, _ in clips]
    pairs = []
    for subject, measured, anatomical in clips:
        known = np.isfinite(measured).all(axis=(1, 2)) & np.isfinite(anatomical).all(axis=(1, 2))
        weight = 1.0 / (len(set(subjects)) * subjects.count(subject) * max(int(known.sum()), 1))
        pairs.append((measured[known], anatomical[known], np.full(int(known.sum()), weight)))
    measured, anatomical, weights = (np.concatenate(each) for each in zip(*pairs, strict=True))
    away = anatomical - measured

    def regression(rows: FloatArray, differences: FloatArray) -> FloatArray:
        weighted = (weights[:, None] * rows).T
        square = weighted @ rows + ridge * np.eye(rows.shape[1])
        return np.linalg.solve(square, weighted @ differences).T.astype(np.float64)

    u, f, one = measured[:, 0], measured[:, 1], np.ones((len(measured), 1))
    return ArmLaw(regression(np.hstack([one, u]), away[:, 0]), regression(np.hstack([one, u, f]), away[:, 1]))


def law_of(clips: list[Clip]) -> ArmLaw:
    """Law fitted to these clips."""
    return fit_arm_law([(each.subject, each.kinect, each.vicon) for each in clips])


def correlation_of(clips: list[Clip]) -> float:
    """Correlation of the errors of a bone's two joints for which the elbow's squared errors match the stated variance.

    The errors are those left by the law in a subject to whom it was not fitted. All subjects have the same weight, and
    so have all clips of a subject. The elevation, whose deviation contains the bend of the spine too, does not count.
    """
    elbow = ANGLES.index("flexion")
    errors, frames = [], []
    for clip in clips:
        law = law_of([each for each in clips if each.subject != clip.subject])
        corrected = [corrected_arms(each, law) for each in clip.skeletons[::_EVERY]]
        frames.append(corrected)
        errors.append((_positional(corrected, 0.0)[0] - clip.angles[::_EVERY])[:, elbow])
    subjects = [each.subject for each in clips]
    weights = 1.0 / np.array([subjects.count(each) for each in subjects])

    def excess(of_bones: float) -> float:
        stated = [_positional(each, of_bones)[1][:, elbow] for each in frames]
        parts = [np.nanmean(e**2 - np.where(np.isnan(e), e, s**2)) for e, s in zip(errors, stated, strict=True)]
        return float(weights @ np.array(parts))

    return float(brentq(excess, 0.0, 0.99, xtol=0.002))


def _positional(skeletons: list[Skeleton], of_bones: float) -> tuple[FloatArray, FloatArray]:
    """(n, 2) the right arm's ``ANGLES``, and (n, 2) their standard deviations; degrees."""
    angles = [positional_angles(each, of_bones) for each in skeletons]
    columns = [angles[0].names.index(name) for name in _NAMES[: len(ANGLES)]]
    return tuple(
        np.degrees([getattr(each, part)[columns] for each in angles]) for part in ("position", "position_stddev")
    )  # type: ignore[return-value]


def measure(job: tuple[Clip, ArmLaw, float, Methods]) -> dict[str, Any]:
    """All figures of one clip: agreement and coverage per method and angle, and the lag."""
    clip, law, of_bones, methods = job
    skeletons = clip.skeletons
    vicon = vicon_arm(clip.folder / f"{clip.name}_vicon.csv.gz")
    corrected = [corrected_kinect(each, law) for each in skeletons]
    outputs = {
        name: filtered(corrected if with_law else skeletons, own, of_bones, lag)
        for name, (own, with_law, lag) in methods.items()
    }
    arms = {RAW: kinect_arm(skeletons)} | {name: kinect_arm(each.skeletons) for name, each in outputs.items()}
    # rows requested by options must not change the others
    warp = align([arms[name] for name in (RAW, *METHODS)], vicon, clip.name)
    figures: dict[str, Any] = {"clip": clip.name, "subject": clip.subject, "explained": warp.explained}
    for name, arm in arms.items():
        at = warp(arm.times)
        figures[name] = {"lag_s": lag(arm, arms[RAW])}
        if name in outputs:
            figures[name]["trunk"] = outputs[name].trunk
        height = sample(at, vicon.times, vicon.height)
        both = (np.abs(height - np.nanmedian(height)) < LOST_MARKER) & np.isfinite(arm.height)
        true, found = (each[both] - each[both].mean() for each in (height, arm.height))
        figures[name]["shoulder"] = {"product": float(true @ found), "square": float(true @ true)}
        for column, angle in enumerate(ANGLES):
            true = sample(at, vicon.times, getattr(vicon, angle))
            figures[name][angle] = asdict(compare(getattr(arm, angle), true))
            rates = np.gradient(getattr(arm, angle) - true, arm.times)
            figures[name][angle]["rate_rms"] = float(np.sqrt(np.nanmean(rates**2)))
            if name in outputs:
                stddev = outputs[name].stddev[:, column]
                known = np.isfinite(true)
                inside = np.abs(outputs[name].published[:, column] - true) <= common.NORMAL * stddev
                figures[name][angle] |= {
                    "coverage": float(inside[known].mean()),
                    "stddev": float(np.median(stddev[known])),
                }
        elevation, flexion = (sample(at, vicon.times, each) for each in (vicon.elevation, vicon.flexion))
        for column, angle in enumerate(PARTIAL, len(ANGLES)):
            true = _where_it_exists(angle, sample(at, vicon.times, getattr(vicon, angle)), elevation, flexion)
            given = outputs[name].published[:, column] if name in outputs else getattr(arm, angle)
            error = (given - true + 180.0) % 360.0 - 180.0
            known = np.isfinite(error)
            if known.sum() < LEAST_SAMPLES:
                continue
            stddev = outputs[name].stddev[known, column] if name in outputs else np.full(known.sum(), np.nan)
            figures[name][angle] = {
                "samples": int(known.sum()),
                "rms": float(np.sqrt(np.mean(error[known] ** 2))),
                "coverage": float((np.abs(error[known]) <= common.NORMAL * stddev).mean()),
                "stddev": float(np.median(stddev)),
            }
    return figures


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed."""
    parser = common.parser(__doc__, jobs=True, data=True)
    parser.add_argument("--fit", action="store_true", help="print the law of all subjects, and end")
    parser.add_argument(
        "--lag", type=float, nargs="+", default=[], metavar="S", help="also smooth with each of these lags (fixed-lag)"
    )
    args = parser.parse_args()
    folder = args.data / "kinect_vs_vicon"
    files = common.recordings(folder, sorted(file.name for file in folder.glob("*_kinect.csv.gz")))
    loaded = common.mapped(load, files, args.jobs)
    clips = [each for each in loaded if each.explained >= LEAST_EXPLAINED]
    if args.fit:
        law = law_of(clips)
        print(np.array2string(law.upper, precision=3, separator=", "))
        print(np.array2string(law.forearm, precision=3, separator=", "))
        print(f"correlation of a bone's joints {correlation_of(clips):.3f}")
        return 0
    subjects = sorted({each.subject for each in clips})
    others = {subject: [each for each in clips if each.subject != subject] for subject in subjects}
    laws = {subject: law_of(each) for subject, each in others.items()}
    correlations = {subject: correlation_of(each) for subject, each in others.items()}
    methods = METHODS | {f"{name}, lag {lag:g}": (name, True, lag) for name in HELD for lag in args.lag}
    jobs = [(each, laws[each.subject], correlations[each.subject], methods) for each in clips]
    rows = common.mapped(measure, jobs, args.jobs)
    table = {angle: {name: _summary(rows, subjects, name, angle) for name in (RAW, *methods)} for angle in ANGLES}
    partial = {angle: {name: _partial(rows, subjects, name, angle) for name in (RAW, *methods)} for angle in PARTIAL}
    trunks = {
        name: [median(row[name]["trunk"] for row in rows if row["subject"] == each) for each in subjects]
        for name in methods
        if name.startswith("ekf")
    }
    shoulders = {
        name: sum(row[name]["shoulder"]["product"] for row in rows)
        / sum(row[name]["shoulder"]["square"] for row in rows)
        for name in (RAW, *methods)
    }
    figures = {
        "clips": rows,
        "used": f"{len(clips)} of {len(files)} clips, {len(subjects)} subjects",
        **table,
        **partial,
        "correlations": correlations,
        "trunks": trunks,
        "shoulders": shoulders,
    }
    common.report(args, figures, unshown=("clips",))
    return common.verdicts(args, _bars(table))


def _summary(rows: list[dict[str, Any]], subjects: list[str], name: str, angle: str) -> dict[str, Any]:
    """Medians over subjects of the medians over clips; ``of_raw`` is the RMS as a ratio to the raw skeleton's."""

    def by_subject(key: str, method: str = name) -> list[float]:
        return [median(row[method][angle][key] for row in rows if row["subject"] == each) for each in subjects]

    def covered(subject: str) -> float:
        clips = [row[name][angle] for row in rows if row["subject"] == subject]
        return float(np.average([each["coverage"] for each in clips], weights=[each["samples"] for each in clips]))

    own, raw = by_subject("rms"), by_subject("rms", RAW)
    return {
        key: median(by_subject(key))
        for key in ("rms", "debiased_rms", "bias", "rate_rms", *(("stddev",) if name != RAW else ()))
    } | {
        "of_raw": median(own) / median(raw),
        "worst": max(one - other for one, other in zip(own, raw, strict=True)),
        "coverage": float(np.mean([covered(each) for each in subjects])) if name != RAW else float("nan"),
        "median_clip": float(np.mean(by_subject("coverage"))) if name != RAW else float("nan"),
        "subjects": own,
    }


def _partial(rows: list[dict[str, Any]], subjects: list[str], name: str, angle: str) -> dict[str, Any]:
    """Medians over subjects of the medians over the clips that have the angle, and the mean coverage of subjects."""
    own = [[row[name][angle] for row in rows if row["subject"] == each and angle in row[name]] for each in subjects]
    own = [clips for clips in own if clips]
    covered = [
        np.average([each["coverage"] for each in clips], weights=[each["samples"] for each in clips]) for clips in own
    ]
    return {
        "subjects": len(own),
        "clips": sum(map(len, own)),
        **{key: median(median(each[key] for each in clips) for clips in own) for key in ("rms", "stddev")},
        "coverage": float(np.mean(covered)) if name != RAW else float("nan"),
    }


def _bars(table: dict[str, dict[str, dict[str, Any]]]) -> dict[str, bool]:
    """Whether each bar is met, by the figures of angle and method."""
    low, high = COVERAGE
    bars = {}
    for name in HELD:
        for angle, bar in BARS.items():
            own = table[angle][name]
            bars[f"{name}: {angle} at most {bar:.2f} of raw"] = own["of_raw"] <= bar
            bars[f"{name}: {angle} of no subject worse than raw by {WORSE} deg"] = own["worst"] <= WORSE
            bars[f"{name}: {angle} covered in {low:.0%} to {high:.0%}"] = low <= own["coverage"] <= high
    return bars


if __name__ == "__main__":
    sys.exit(main())
