"""Orientation from raw inertial data against Vicon: a pendulum of three links, 174 s (Szczesna et al. 2016).

Each link carries an inertial sensor, from whose rate, acceleration and magnetic field ``OrientationEstimator`` makes
orientations, reading by reading. Fitted per link, as published comparisons do: one constant rotation from the sensor to
the link, one from the earth to Vicon's frame (among them the heading), and an offset of the clocks of up to 0.1 s.

- ``total``: RMS of the angle of what is left between ours and Vicon's orientation, degrees; ``inclination``: of that
  part of it whose axis is level. ``stated``: RMS of our own standard deviation of the same.
- ``joint``: RMS error of the angle about the hinge between two links.

Left out: Vicon's frames within half a second of where its orientation is none (a quaternion that is not of unit length)
or jumps by more than the gyroscope saw. On the third link, whose markers it swapped at times, these are ``left out``.
The exit code is 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation, Slerp

from body_tracking.errors import BodyTrackingError
from body_tracking.sensors.imu_csv import ImuCsvRecording
from body_tracking.sensors.imu_orientation import OrientationEstimator
from body_tracking.skeleton import NANOSECONDS, BoolArray, FloatArray

LINKS = (1, 2, 3)
TOTAL_BAR, INCLINATION_BAR, JOINT_BAR = 2.0, 1.0, 2.5
SETTLING_S = 1.0
_AROUND_S = 0.5
_JUMP = np.radians(3.0)
_OFFSET_S = 0.1
_COARSE = 20


@dataclass(frozen=True)
class Link:
    """Figures of one link: seconds, shares, degrees."""

    offset_s: float
    left_out: float
    total: float
    inclination: float
    stated_total: float
    stated_inclination: float
    worst: float
    disturbed: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """Orientations of a link at Vicon's times, ours after the fit, as (n, 3, 3) matrices."""

    times: FloatArray
    ours: FloatArray
    vicon: FloatArray


def nearest(matrix: FloatArray) -> FloatArray:
    """The rotation nearest to a matrix (Umeyama 1991)."""
    left, _, right = np.linalg.svd(matrix)
    result: FloatArray = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return result


def fit(ours: FloatArray, vicon: FloatArray, rounds: int) -> tuple[FloatArray, FloatArray]:
    """World and mounting (3, 3) for which ``world @ ours @ mounting`` is nearest to Vicon's, by turns."""
    mounting = ours[0].T @ vicon[0]
    for _ in range(rounds):
        world = nearest(np.einsum("nij,nkj->ik", vicon, ours @ mounting))
        mounting = nearest(np.einsum("nji,njk->ik", world @ ours, vicon))
    return world, mounting


def sound(columns: FloatArray) -> BoolArray:
    """Which of Vicon's frames are none of those that are left out."""
    times, quats, rates = columns[:, 0], columns[:, [2, 3, 4, 1]], columns[:, 8:11]
    wrong = ~(np.abs(np.linalg.norm(quats, axis=1) - 1.0) < 0.01)
    turned = 2.0 * np.arccos(np.clip(np.abs((quats[1:] * quats[:-1]).sum(axis=1)), 0.0, 1.0))
    speed = np.linalg.norm(rates, axis=1)
    allowed = 1.5 * np.maximum(speed[1:], speed[:-1]) * np.maximum(np.diff(times), 0.011) + _JUMP
    wrong[1:] |= ~(turned < allowed)
    away = np.abs(times[:, None] - times[wrong]) > _AROUND_S
    return np.asarray(away.all(axis=1))


def measure(path: Path) -> tuple[Link, Fitted]:
    """One link."""
    estimator = OrientationEstimator()
    found, disturbed = [], []
    for reading in ImuCsvRecording(path):
        orientation = estimator.update(reading.sample)
        if orientation is not None:
            found.append(orientation)
            disturbed.append(bool(estimator.magnetically_disturbed))
    stamps = np.array([each.stamp_ns for each in found]) / NANOSECONDS
    course = Slerp(stamps, Rotation.from_quat([each.orientation for each in found]))
    variances = np.array([each.covariance.diagonal() for each in found])
    columns = np.genfromtxt(path, delimiter=";", skip_header=2)
    kept = sound(columns)
    times = columns[:, 0]
    inside = kept & (times > stamps[0] + SETTLING_S) & (times < stamps[-1] - _OFFSET_S)
    times, vicon = times[inside], Rotation.from_quat(columns[inside][:, [2, 3, 4, 1]]).as_matrix()

    def apart(offset: float) -> float:
        ours = course(times[::_COARSE] + offset).as_matrix()
        world, mounting = fit(ours, vicon[::_COARSE], 40)
        return -float(np.einsum("nij,nij->", vicon[::_COARSE], world @ ours @ mounting))

    offset = minimize_scalar(apart, bounds=(-_OFFSET_S, _OFFSET_S), method="bounded", options={"xatol": 1e-3}).x
    ours = course(times + offset).as_matrix()
    world, mounting = fit(ours[::5], vicon[::5], 300)
    ours = world @ ours @ mounting
    error = Rotation.from_matrix(vicon @ ours.swapaxes(1, 2)).as_rotvec()
    level = error - np.outer(error @ world[:, 2], world[:, 2])
    size = np.linalg.norm(error, axis=1)
    return Link(
        offset_s=float(offset),
        left_out=float(1.0 - kept.mean()),
        total=_rms(size),
        inclination=_rms(np.linalg.norm(level, axis=1)),
        stated_total=_rms(np.sqrt(variances.sum(axis=1))),
        stated_inclination=_rms(np.sqrt(variances[:, :2].sum(axis=1))),
        worst=float(np.degrees(size.max())),
        disturbed=float(np.mean(disturbed)),
    ), Fitted(times, ours, vicon)


def hinge(upper: Fitted, lower: Fitted) -> float:
    """RMS error of the angle about the hinge, along the links' z, degrees."""
    _, first, second = np.intersect1d(upper.times, lower.times, return_indices=True)
    angles = []
    for above, below in ((upper.ours, lower.ours), (upper.vicon, lower.vicon)):
        quats = Rotation.from_matrix(above[first].swapaxes(1, 2) @ below[second]).as_quat()
        angles.append(2.0 * np.arctan2(quats[:, 2], quats[:, 3]))
    return _rms(np.angle(np.exp(1j * (angles[0] - angles[1]))))


def _rms(radians: FloatArray) -> float:
    return float(np.degrees(np.sqrt(np.mean(np.square(radians)))))


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed or on an error, 2 where the files are absent."""
    root = Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("BODY_TRACKING_DATA", root.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of real recordings (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    args = parser.parse_args()
    folder = args.data / "imu" / "pendulum_with_reference"
    files = [folder / f"Pendulum_Test02a_Trial1_Segment_{link}.csv.gz" for link in LINKS]
    if not all(path.is_file() for path in files):
        print(f"the real recordings are absent ({folder})", file=sys.stderr)
        return 2
    try:
        measured = [measure(path) for path in files]
    except BodyTrackingError as error:
        print(error, file=sys.stderr)
        return 1
    links = [link for link, _ in measured]
    joints = [hinge(upper, lower) for (_, upper), (_, lower) in pairwise(measured)]
    missed = [
        *(f"link {k}: total" for k, link in zip(LINKS, links, strict=True) if link.total > TOTAL_BAR),
        *(f"link {k}: inclination" for k, link in zip(LINKS, links, strict=True) if link.inclination > INCLINATION_BAR),
        *(f"joint {k}-{k + 1}" for k, joint in zip(LINKS, joints, strict=False) if joint > JOINT_BAR),
    ]
    if args.json:
        print(json.dumps({"links": [asdict(link) for link in links], "joints": joints, "missed": missed}, indent=2))
        return 1 if missed else 0
    print("degrees" + "".join(f"{name:>14}" for name in ("total", "stated", "inclination", "stated", "worst")), end="")
    print(f"{'left out':>12}{'disturbed':>12}{'clock':>10}")
    for number, link in zip(LINKS, links, strict=True):
        cells = (link.total, link.stated_total, link.inclination, link.stated_inclination, link.worst)
        print(f"link {number} " + "".join(f"{value:>14.2f}" for value in cells), end="")
        print(f"{link.left_out:>12.1%}{link.disturbed:>12.1%}{1e3 * link.offset_s:>7.0f} ms")
    for number, joint in zip(LINKS, joints, strict=False):
        print(f"joint {number}-{number + 1} {joint:>11.2f}")
    print(f"bars: total {TOTAL_BAR}, inclination {INCLINATION_BAR}, joint {JOINT_BAR}")
    if missed:
        print(f"missed: {', '.join(missed)}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
