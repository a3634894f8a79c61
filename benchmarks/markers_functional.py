"""Joints of real marker clusters on skin: Qualisys trials of a knee and a hip, a Plug-in Gait trial of two elbows.

Poses of clusters by an unweighted fit (Umeyama 1991) of the mean shape; the noise of a marker is 1 mm.

- ``knee``: the hinge between the clusters of thigh and shank, and the angle in the thigh and in the shank between its
  axes in the first and the second half of the trial; the first bends the knee by 128 deg, the second by 86. Also by the
  closed form (SARA), over frames of a bend that occurs in both halves, and, for the error of the method itself, of
  every other frame against the rest. ``floor``: RMS over that common bend, in steps of 5 deg, of the difference between
  the halves in the shank's rotation out of the hinge's plane. At the same bend no hinge explains it, nor any joint of
  one degree of freedom: the knee turns about its long axis, and the clusters move on the skin. The floor shows the size
  of these effects; it is no strict bound on the axis.
- ``hip``: the ball joint between the markers of the pelvis and the thigh's cluster. ``hip, wrong``: with the
  epicondyles as part of the thigh's cluster, which is then not rigid.
- ``elbow``: a hinge between upper arm and forearm, which bend by 9 (left) and 15 deg (right).
- ``gap``: RMS distance between both targets' centres, mm; ``turn``: RMS rotation that the joint does not allow,
  deg; ``scale``: errors in units of the markers' noise; ``motion``: RMS rotations about the principal axes, deg.
- biobuddy (SCoRE and SARA, Ehrig et al. 2006 and 2007) on all of the same poses, against our closed form and against
  the maximum likelihood that starts from it: distance of the hip's centre and of the knee's axis (at our centre), mm,
  and the angle of the knee's axis, degrees. Left out where biobuddy is not installed (``pip install biobuddy``; 0.3.2
  was compared).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import numpy as np
from joint_pairs import fit_pair

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.joint_model import Joint, JointKind, about_z, turn_angles
from body_tracking.markers.joint_starts import closed_form
from body_tracking.markers.joints import JointFit, relative_poses
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.pose_table import pose_table

NOISE = 1e-3
"""Standard deviation of a marker per axis, metres."""
STEP_DEG = 5.0
HALVES_BAR_DEG, PEER_BAR_MM, PEER_BAR_DEG = 2.0, 0.5, 0.2
THIGH, SHANK = ("RTHI1", "RTHI2", "RTHI3"), ("RLEG1", "RLEG2", "RLEG3")
PELVIS, EPICONDYLES = ("LPSIS", "RPSIS", "LASIS", "RASIS"), ("RLFE", "RMFE")


@dataclass(frozen=True)
class Peer:
    """Distance of our joint from biobuddy's, in the parent target and in the child target."""

    joint: str
    ours: str
    parent_mm: float
    child_mm: float
    parent_deg: float
    child_deg: float


def markers(path: Path) -> dict[str, FloatArray]:
    """(n, 3) positions of each marker of a C3D file, metres."""
    import ezc3d

    file = ezc3d.c3d(str(path))
    labels = file["parameters"]["POINT"]["LABELS"]["value"]
    return dict(zip(labels, 1e-3 * np.moveaxis(file["data"]["points"][:3], 0, -1), strict=False))


def cluster(trial: dict[str, FloatArray], names: tuple[str, ...]) -> list[TargetPose]:
    """Poses of a target of these markers with their mean shape (Umeyama 1991, eq. 39-42)."""
    points = np.stack([trial[name] for name in names], axis=1)
    centre = points.mean(axis=1, keepdims=True)
    shape = points[0] - centre[0]
    for _ in range(5):
        u, _, v = np.linalg.svd(np.einsum("nki,kj->nij", points - centre, shape))
        sign = np.tile(np.eye(3), (len(points), 1, 1))
        sign[:, 2, 2] = np.linalg.det(u @ v)
        rotations = u @ sign @ v
        shape = np.einsum("nij,nki->nkj", rotations, points - centre).mean(axis=0)
    turned = np.einsum("nij,kj->nki", rotations, shape)
    residual = np.sqrt(((points - centre - turned) ** 2).sum(axis=-1).mean(axis=1))
    information = np.zeros((len(points), 6, 6))
    for x, y, z in np.moveaxis(turned, (1, 2), (0, 1)):
        by_pose = np.zeros((len(points), 3, 6))
        by_pose[:, :, :3] = np.eye(3)
        by_pose[:, 0, 4], by_pose[:, 0, 5] = z, -y
        by_pose[:, 1, 3], by_pose[:, 1, 5] = -z, x
        by_pose[:, 2, 3], by_pose[:, 2, 4] = y, -x
        information += by_pose.swapaxes(-1, -2) @ by_pose / NOISE**2
    covariance = np.linalg.inv(information)
    name, seen = "_".join(names), np.arange(len(names))
    return [
        TargetPose(name, 10_000_000 * row, "lab", rotations[row], centre[row, 0], covariance[row], seen, residual[row])
        for row in range(len(points))
    ]


def figures_of(fit: JointFit) -> dict[str, Any]:
    """Figures of a fit; stated deviations are the lengths of vectors of standard deviations."""
    deviations = np.sqrt(fit.joint.covariance.diagonal())
    return {
        "frames": fit.frames,
        "motion, deg": np.degrees(fit.motion).tolist(),
        "scale": fit.scale,
        "gap, mm": 1e3 * fit.gap,
        "turn, deg": np.degrees(fit.turn),
        "centre +-, mm": 1e3 * np.linalg.norm(deviations[:3]),
        "axis +-, deg": np.degrees(np.linalg.norm(deviations[3:6])),
        "verdict": fit.verdict.value,
        "warnings": "; ".join(fit.warnings),
    }


def halves_of(thigh: list[TargetPose], shank: list[TargetPose], whole: Joint) -> tuple[dict[str, Any], float]:
    """Degrees between the knee's axes of both halves in the thigh and in the shank, by several fits; and the floor."""
    rows = np.arange(len(thigh))
    parts = rows[: len(rows) // 2], rows[len(rows) // 2 :]
    turns = np.stack([one.rotation.T @ other.rotation for one, other in zip(thigh, shank, strict=True)])
    turns = whole.parent_rotation.T @ turns @ whole.child_rotation
    bend = np.degrees(np.unwrap(turn_angles(JointKind.HINGE, turns)[:, 0]))
    first, last = (pick(each(bend[part]) for part in parts) for pick, each in ((max, np.min), (min, np.max)))
    common_bend = [part[(bend[part] >= first) & (bend[part] <= last)] for part in parts]

    def likely(part: IntArray) -> Joint:
        return fit_pair(JointKind.HINGE, [thigh[row] for row in part], [shank[row] for row in part], "knee").joint

    def sara(part: IntArray) -> Joint:
        targets = thigh[0].name, shank[0].name
        table = pose_table([[thigh[row], shank[row]] for row in part], targets)
        return closed_form("knee", *targets, JointKind.HINGE, *relative_poses(table))

    found = {}
    for name, fit, pair in (
        ("alternate frames", likely, (rows[::2], rows[1::2])),
        ("maximum likelihood", likely, parts),
        ("closed form", sara, parts),
        ("the same bend", likely, common_bend),
    ):
        one, other = (fit(part) for part in pair)
        found[name] = {
            "in the thigh": axis_angle(one.parent_axis, other.parent_axis),
            "in the shank": axis_angle(one.child_axis, other.child_axis),
        }
    aside = np.degrees(so3.rotation_vectors(about_z(np.radians(-bend)) @ turns))[:, :2]
    steps = [np.floor((bend[part] - first) / STEP_DEG) for part in common_bend]
    both = np.intersect1d(*steps)
    apart = [
        np.subtract(*(aside[part[step == each]].mean(axis=0) for part, step in zip(common_bend, steps, strict=True)))
        for each in both
    ]
    return found, common.rms(np.linalg.norm(apart, axis=1))


def axis_angle(first: FloatArray, second: FloatArray) -> float:
    """Angle between two axes of any sign, degrees."""
    angle = float(np.degrees(common.between(first, second)))
    return min(angle, 180.0 - angle)


def peers(name: str, parent: list[TargetPose], child: list[TargetPose], fit: JointFit) -> list[Peer]:
    """The same joint by biobuddy; empty where it is not installed."""
    try:
        from biobuddy.model_modifiers.joint_center_tool import Sara, Score
        from biobuddy.utils.linear_algebra import RotoTransMatrixTimeSeries
    except ImportError:
        return []

    def series(poses: list[TargetPose]) -> object:
        matrices = np.tile(np.eye(4)[..., None], (1, 1, len(poses)))
        matrices[:3, :3] = np.stack([pose.rotation for pose in poses], axis=-1)
        matrices[:3, 3] = np.stack([pose.translation for pose in poses], axis=-1)
        return RotoTransMatrixTimeSeries.from_rt_matrix(matrices)

    poses = series(parent), series(child)
    targets = parent[0].name, child[0].name
    table = pose_table(list(zip(parent, child, strict=True)), targets)
    start = closed_form(name, *targets, fit.joint.kind, *relative_poses(table))
    hinge = fit.joint.kind is JointKind.HINGE
    if hinge:
        _, parent_axis, child_axis, _, parent_centre, child_centre, _, _ = Sara.perform_algorithm(
            *poses, recursive_outlier_removal=False
        )
    else:
        _, parent_centre, child_centre, _, _ = Score.perform_algorithm(*poses, recursive_outlier_removal=False)

    def away(centre: FloatArray, axis: FloatArray, theirs: FloatArray) -> float:
        apart = centre - theirs
        return 1e3 * float(np.linalg.norm(np.cross(apart, axis) if hinge else apart))

    def against(ours: str, joint: Joint) -> Peer:
        if not hinge:
            none = np.zeros(3)
            distances = (
                away(joint.parent_centre, none, parent_centre),
                away(joint.child_centre, none, child_centre),
            )
            return Peer(name, ours, *distances, 0.0, 0.0)
        return Peer(
            name,
            ours,
            away(joint.parent_centre, parent_axis, parent_centre),
            away(joint.child_centre, child_axis, child_centre),
            axis_angle(joint.parent_axis, parent_axis),
            axis_angle(joint.child_axis, child_axis),
        )

    return [against("closed form", start), against("maximum likelihood", fit.joint)]


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed, 2 where the files are absent."""
    args = common.parser(__doc__, data=True).parse_args()
    knee_file, hip_file = common.recordings(args.data / "marker_functional", ["right_knee.c3d", "right_hip.c3d"])
    (gait_file,) = common.recordings(args.data / "plug_in_gait", ["cgm__Test_Files__Movement_trial.c3d"])

    trial = markers(knee_file)
    thigh, shank = cluster(trial, THIGH), cluster(trial, SHANK)
    fits = {"knee": fit_pair(JointKind.HINGE, thigh, shank, "knee")}
    halves, floor = halves_of(thigh, shank, fits["knee"].joint)
    beside = peers("knee", thigh, shank, fits["knee"])

    trial = markers(hip_file)
    pelvis, thigh = cluster(trial, PELVIS), cluster(trial, THIGH)
    fits["hip"] = fit_pair(JointKind.BALL, pelvis, thigh, "hip")
    fits["hip, wrong"] = fit_pair(JointKind.BALL, pelvis, cluster(trial, THIGH + EPICONDYLES), "hip")
    beside += peers("hip", pelvis, thigh, fits["hip"])

    trial = markers(gait_file)
    for side in ("L", "R"):
        upper = cluster(trial, (f"{side}SHO", f"{side}UPA", f"{side}ELB"))
        lower = cluster(trial, (f"{side}FRM", f"{side}WRA", f"{side}WRB"))
        fits[f"elbow {side}"] = fit_pair(JointKind.HINGE, upper, lower, "elbow")

    met = {
        f"knee's axis of both halves within {HALVES_BAR_DEG:g} deg {where} (floor {floor:.1f})": value <= HALVES_BAR_DEG
        for where, value in halves["maximum likelihood"].items()
    }
    met["hip: soft tissue is named"] = any("soft tissue" in warning for warning in fits["hip"].warnings)
    met["hip with the epicondyles: not rigid"] = fits["hip, wrong"].verdict == "not_rigid"
    for side in ("L", "R"):
        met[f"elbow {side}: motion too small"] = fits[f"elbow {side}"].verdict == "small_motion"
    if not beside:
        common.progress("biobuddy is not installed: not compared with it")
    for peer in beside:
        if peer.ours == "closed form":
            near = max(peer.parent_mm, peer.child_mm) <= PEER_BAR_MM
            met[f"{peer.joint}: as biobuddy"] = near and max(peer.parent_deg, peer.child_deg) <= PEER_BAR_DEG
    figures = {name: figures_of(fit) for name, fit in fits.items()}
    common.report(
        args,
        {
            "knee's axis, first against second half, deg": halves,
            "its floor, deg": floor,
            "fits": figures,
            "biobuddy": beside,
        },
    )
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
