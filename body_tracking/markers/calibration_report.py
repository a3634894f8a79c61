"""Quality of a camera calibration, in the form of Gaschler's table 4.1."""

from __future__ import annotations

import numpy as np

from body_tracking.core import so3
from body_tracking.markers import projection
from body_tracking.markers.camera_calibration import CameraCalibration
from body_tracking.markers.rig import LENS, Rig


def table(calibration: CameraCalibration) -> str:
    """Parameters of the cameras with their standard deviations, and residuals by axis, in the form of table 4.1."""
    rig, lines = calibration.rig, []
    deviations = np.sqrt(np.diag(rig.covariance))
    by_axis, rms = calibration.rms_by_axis(), calibration.rms()
    for index, (camera, start) in enumerate(zip(rig.cameras, projection.offsets(rig)[:-1], strict=True)):
        values = [*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion]
        names = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
        lines.append(f"camera {camera.frame_id}")
        for offset, (name, value) in enumerate(zip(names, values, strict=False)):
            deviation, unit = deviations[start + offset], " px" if offset < LENS else ""
            if deviation > 0.0 or offset < LENS or value:
                digits = 2 if offset < LENS else 4
                lines.append(f"  {name:<12}{value:.{digits}f} +- {deviation:.{digits}f}{unit}")
        if index:
            lines += _pose(rig, index)
        x, y = by_axis[index]
        lines.append(
            f"  residual    x {x:.3f} px, y {y:.3f} px; as OpenCV gives it, of the 2D norm: {rms[index]:.3f} px"
        )
    for each in calibration.rejected:
        who = "in both cameras" if each.camera is None else f"in camera {each.camera}"
        lines.append(f"left out: view {each.view} {who}, {each.reason}")
    return "\n".join(lines) + "\n"


def _pose(rig: Rig, index: int) -> list[str]:
    start = projection.offsets(rig)[index + 1] - 6
    covariance = rig.covariance[start : start + 6, start : start + 6]
    turn = so3.rotation_vectors(rig.rotations[index])
    shift = rig.translations[index]
    place = -1e3 * rig.rotations[index].T @ shift
    angle, distance = float(np.linalg.norm(turn)), float(np.linalg.norm(shift))
    # the rotation vector is its own eigenvector: the angle changes by the component of w along it
    angle_deviation = float(np.sqrt(turn @ covariance[:3, :3] @ turn)) / max(angle, 1e-12)
    distance_deviation = float(np.sqrt(shift @ covariance[3:, 3:] @ shift)) / max(distance, 1e-12)
    return [
        f"  R           [{turn[0]:.4f} {turn[1]:.4f} {turn[2]:.4f}] rad, "
        f"{np.degrees(angle):.3f} +- {np.degrees(angle_deviation):.3f} deg",
        f"  t           [{shift[0] * 1e3:.2f} {shift[1] * 1e3:.2f} {shift[2] * 1e3:.2f}] mm, "
        f"{distance * 1e3:.2f} +- {distance_deviation * 1e3:.2f} mm",
        f"  at          {place[0]:.1f} {place[1]:.1f} {place[2]:.1f} mm in the first camera's frame; R and t convert "
        "from that frame to this camera's",
    ]
