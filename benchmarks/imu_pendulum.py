"""Orientation from raw inertial data against Vicon: a pendulum of three links, 174 s (Szczesna et al. 2016).

Each link carries an inertial sensor. From its rate, acceleration and magnetic field, ``OrientationEstimator`` computes
orientations, reading by reading. Fitted per link: one constant rotation from the sensor to the link, one from the earth
to Vicon's frame. ``total``: RMS of the angle between ours and Vicon's orientation, degrees; ``inclination``: of its
part about level axes; ``stated``: RMS of our own standard deviation; ``joint``: RMS error of the angle about the
hinge between two links.

Vicon's clock wanders against that of the sensors, by the same on each link: its frames were spread evenly over the
rows, even where the log of the sensors paused for 0.02 to 0.18 s. So for each link the course of the offset is
estimated from the two other links, from their rates against those of Vicon. ``by 1 offset``: by one constant offset of
up to 0.1 s that is fitted to the link itself. The bars apply to the former.

Left out: Vicon's frames within half a second of a frame with an invalid orientation (the quaternion has not unit
length), a frame of a standstill to the last digit for half a second, or one that turns by 3 degrees more or less than
the frames around it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import common
import numpy as np
from common import rms_deg
from scipy.ndimage import binary_opening, median_filter
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation, Slerp

from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.inertial.imu_csv import ImuCsvRecording
from body_tracking.inertial.imu_orientation import InertialErrors, OrientationEstimator

LINKS = (1, 2, 3)
TOTAL_BAR, INCLINATION_BAR, JOINT_BAR = 2.0, 1.0, 2.5
SETTLING_S = 1.0
_AROUND_S = 0.5
_JUMP = np.radians(3.0)
_AMONG = 9
"""Number of frames in the running median of the turns."""
_HELD_S = 0.5
_OFFSET_S = 0.1
_COARSE = 20
_KNOT = 20
"""Frames between two knots of the offset's course."""
_BEND_S = 0.006
"""Standard deviation of the offset's second difference over the knots, seconds."""
_FAR_S = 0.1
"""Standard deviation of the offset itself, seconds."""
_STRIDE_S = 0.02
_ROUNDS = 15
RANGE = np.radians(600.0)
"""Range of the gyroscopes, rad/s: the third one's readings end there."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One link: our estimates at ``stamps`` (n,), and Vicon's frames at ``times`` (m,), seconds.

    Attributes:
        ours: (n,) orientations.
        rates: (n, 3) rad/s in the sensor's frame.
        variances: (n, 3) of the orientations, rad2.
        disturbed: share of readings in a disturbed magnetic field.
        vicon: (m, 3, 3) orientations.
        turns: (m - 1, 3) rotation vectors from frame to frame in the link's frame, radians.
        kept: (m,) whether the frame is used.
    """

    stamps: FloatArray
    ours: Rotation
    rates: FloatArray
    variances: FloatArray
    disturbed: float
    times: FloatArray
    vicon: FloatArray
    turns: FloatArray
    kept: BoolArray


@dataclass(frozen=True, eq=False)
class Fitted:
    """Orientations (n, 3, 3) of a link at Vicon's times, ours after the fit, and the errors (n, 3), radians.

    ``world`` and ``mounting`` (3, 3) are the fitted rotations.
    """

    times: FloatArray
    ours: FloatArray
    vicon: FloatArray
    errors: FloatArray
    world: FloatArray
    mounting: FloatArray

    @property
    def total(self) -> float:
        """RMS of the total angle, degrees."""
        return rms_deg(np.linalg.norm(self.errors, axis=1))

    @property
    def inclination(self) -> float:
        """RMS of the inclination, degrees."""
        up = self.world[:, 2]
        return rms_deg(np.linalg.norm(self.errors - np.outer(self.errors @ up, up), axis=1))


def fit(ours: FloatArray, vicon: FloatArray, rounds: int) -> tuple[FloatArray, FloatArray]:
    """World and mounting (3, 3) that bring ``world @ ours @ mounting`` closest to Vicon, by alternating fits."""
    mounting = ours[0].T @ vicon[0]
    for _ in range(rounds):
        world = so3.nearest_rotation(np.einsum("nij,nkj->ik", vicon, ours @ mounting))
        mounting = so3.nearest_rotation(np.einsum("nji,njk->ik", world @ ours, vicon))
    return world, mounting


def sound(times: FloatArray, quats: FloatArray, turns: FloatArray) -> BoolArray:
    """(m,) whether Vicon's frames are used (see above)."""
    wrong = ~(np.abs(np.linalg.norm(quats, axis=1) - 1.0) < 0.01)
    odd = np.linalg.norm(turns - median_filter(turns, (_AMONG, 1), mode="nearest"), axis=1) > _JUMP
    same = (quats[1:] == quats[:-1]).all(axis=1)
    held = binary_opening(same, np.ones(round(_HELD_S * len(times) / np.ptp(times)), dtype=np.bool_))
    wrong[1:] |= odd | held
    away = np.abs(times[:, None] - times[wrong]) > _AROUND_S
    return np.asarray(away.all(axis=1))


def record(path: Path) -> Recording:
    """Read one link."""
    estimator = OrientationEstimator(errors=InertialErrors(gyro_range=RANGE))
    found, disturbed = [], []
    for reading in ImuCsvRecording(path):
        orientation = estimator.update(reading.sample)
        if orientation is not None:
            found.append(orientation)
            disturbed.append(bool(estimator.magnetically_disturbed))
    columns = np.genfromtxt(path, delimiter=";", skip_header=2, usecols=range(5))
    times, quats = columns[:, 0], columns[:, [2, 3, 4, 1]]
    vicon = Rotation.from_quat(np.where(np.abs(quats).sum(axis=1, keepdims=True) > 0.0, quats, [0.0, 0.0, 0.0, 1.0]))
    turns = (vicon[:-1].inv() * vicon[1:]).as_rotvec()
    return Recording(
        np.array([each.stamp_ns for each in found]) / NANOSECONDS,
        Rotation.from_quat([each.orientation for each in found]),
        np.array([each.angular_velocity for each in found]),
        np.array([each.covariance.diagonal() for each in found]),
        float(np.mean(disturbed)),
        times,
        vicon.as_matrix(),
        turns,
        sound(times, quats, turns),
    )


def fitted(link: Recording, offsets: FloatArray | float, rounds: int, every: int = 1) -> Fitted:
    """Fit world and mounting for clock offsets in s: one, or one for each of Vicon's frames."""
    at = link.times + offsets
    inside = link.kept & (link.times > link.stamps[0] + SETTLING_S) & (link.times < link.stamps[-1] - _OFFSET_S)
    inside &= (at > link.stamps[0]) & (at < link.stamps[-1])
    which = np.flatnonzero(inside)[::every]
    ours, vicon = Slerp(link.stamps, link.ours)(at[which]).as_matrix(), link.vicon[which]
    thin = slice(None, None, 5 if every == 1 else 1)
    world, mounting = fit(ours[thin], vicon[thin], rounds)
    ours = world @ ours @ mounting
    errors = Rotation.from_matrix(vicon @ ours.swapaxes(1, 2)).as_rotvec()
    return Fitted(link.times[which], ours, vicon, errors, world, mounting)


def one_offset(link: Recording) -> Fitted:
    """Fit with the best constant offset of at most 0.1 s."""

    def apart(offset: float) -> float:
        return fitted(link, offset, 40, _COARSE).total

    best = minimize_scalar(apart, bounds=(-_OFFSET_S, _OFFSET_S), method="bounded", options={"xatol": 1e-3}).x
    return fitted(link, best, 300)


def rate_at(link: Recording, times: FloatArray) -> FloatArray:
    """(n, 3) rates in the sensor's frame, interpolated, rad/s."""
    return np.stack([np.interp(times, link.stamps, column) for column in link.rates.T], axis=1)


def wandering(links: list[tuple[Recording, FloatArray]]) -> FloatArray:
    """(m,) clock offsets at Vicon's frames, seconds, from the rates of links with their mountings (3, 3).

    Piecewise linear over knots; a Gauss-Newton fit with Cauchy weights minimises the difference of the rates.
    """
    times = links[0][0].times
    frames = np.arange(len(times) - 1) + 0.5
    middle, frame_s = 0.5 * (times[1:] + times[:-1]), float(np.median(np.diff(times)))
    knot, share = np.divmod(frames / _KNOT, 1.0)
    count = int(knot[-1]) + 2
    rows = np.tile(np.arange(len(frames)), 2)
    entries = np.concatenate([1.0 - share, share]), (rows, np.concatenate([knot, knot + 1.0]).astype(int))
    linear = csr_array(entries, shape=(len(frames), count))
    bend = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
    smooth = bend.T @ bend / _BEND_S**2 + eye_array(count) / _FAR_S**2
    offsets = np.zeros(count)
    for _ in range(_ROUNDS):
        normal, right = smooth, -smooth @ offsets
        at = middle + linear @ offsets
        for link, mounting in links:
            usable = link.kept[1:] & link.kept[:-1]
            rates = [rate_at(link, at + shift) @ mounting for shift in (-frame_s, 0.0, frame_s)]
            residual, slope = link.turns / frame_s - rates[1], (rates[2] - rates[0]) / (2.0 * frame_s)
            size = np.linalg.norm(residual, axis=1)
            scale = float(np.median(size[usable]))
            weights = usable / (1.0 + (size / (2.0 * scale)) ** 2) / scale**2
            normal = normal + linear.T @ diags_array(weights * (slope**2).sum(axis=1)) @ linear
            right = right + linear.T @ (weights * (slope * residual).sum(axis=1))
        offsets = offsets + np.clip(spsolve(normal.tocsc(), right), -_STRIDE_S, _STRIDE_S)
    return np.asarray(np.interp(np.arange(len(times)), frames, linear @ offsets))


def hinge(upper: Fitted, lower: Fitted) -> float:
    """RMS error of the angle about the hinge, which is the links' z axis, degrees."""
    _, first, second = np.intersect1d(upper.times, lower.times, return_indices=True)
    angles = []
    for above, below in ((upper.ours, lower.ours), (upper.vicon, lower.vicon)):
        quats = Rotation.from_matrix(above[first].swapaxes(1, 2) @ below[second]).as_quat()
        angles.append(2.0 * np.arctan2(quats[:, 2], quats[:, 3]))
    return rms_deg(np.angle(np.exp(1j * (angles[0] - angles[1]))))


def measure(recordings: list[Recording]) -> tuple[list[dict[str, Any]], list[Fitted]]:
    """Figures of each link with the clock offsets by the others: degrees, shares, milliseconds (1, 50 and 99 %)."""
    constant = [one_offset(recording) for recording in recordings]
    links, fits = [], []
    for k, recording in enumerate(recordings):
        others = [(each, one.mounting) for each, one in zip(recordings, constant, strict=True) if each is not recording]
        offsets = wandering(others)
        result = fitted(recording, offsets, 300)
        links.append(
            {
                "total": result.total,
                "stated": rms_deg(np.sqrt(recording.variances.sum(axis=1))),
                "by 1 offset": constant[k].total,
                "inclination": result.inclination,
                "stated inclination": rms_deg(np.sqrt(recording.variances[:, :2].sum(axis=1))),
                "inclination by 1 offset": constant[k].inclination,
                "worst": float(np.degrees(np.linalg.norm(result.errors, axis=1).max())),
                "left out": float(1.0 - recording.kept.mean()),
                "disturbed": recording.disturbed,
                "offsets, ms": (1e3 * np.percentile(offsets, [1.0, 50.0, 99.0])).round().tolist(),
            }
        )
        fits.append(result)
    return links, fits


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed, 2 where the files are absent."""
    args = common.parser(__doc__, data=True).parse_args()
    folder = args.data / "imu" / "pendulum_with_reference"
    files = common.recordings(folder, [f"Pendulum_Test02a_Trial1_Segment_{link}.csv.gz" for link in LINKS])
    recordings = [record(path) for path in files]
    links, fits = measure(recordings)
    joints = [hinge(upper, lower) for upper, lower in pairwise(fits)]
    figures = {f"link {number}": link for number, link in zip(LINKS, links, strict=True)}
    common.report(args, {"joints": joints, "degrees": figures})
    met = {}
    for name, link in figures.items():
        met[f"{name}: total at most {TOTAL_BAR}"] = link["total"] <= TOTAL_BAR
        met[f"{name}: inclination at most {INCLINATION_BAR}"] = link["inclination"] <= INCLINATION_BAR
    met |= {f"joint {k}-{k + 1} at most {JOINT_BAR}": joint <= JOINT_BAR for k, joint in enumerate(joints, 1)}
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
