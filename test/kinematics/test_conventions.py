"""Angle conventions: rotations built anew from the angles, textbook poses, derivatives, honest uncertainty."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.conventions import (
    CONVENTIONS,
    UNIFORM_STDDEV,
    ConventionError,
    angles_of,
)
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26
from body_tracking.kinematics.upper_body import SHOULDER_AXES, UpperBody
from draws import draws, some

MODEL = UpperBody()
LENGTHS = MODEL.default_lengths()
NV = MODEL.nv
RANGES = Ranges(MODEL)
SIDES = (("left", 1.0), ("right", -1.0))
X, Y, Z = np.eye(3)
DEGREE = np.pi / 180.0
OUTER_OF_MODEL = ("shoulder_flexion", "shoulder_abduction", "shoulder_rotation")


def estimate(
    q: FloatArray, stddev: float = 1e-9, velocity: FloatArray | None = None, covariance: FloatArray | None = None
) -> ModelEstimate:
    return ModelEstimate(
        stamp_ns=7,
        frame_id="world",
        body=0,
        q=q,
        velocity=np.zeros(NV) if velocity is None else velocity,
        covariance=stddev**2 * np.eye(2 * NV) if covariance is None else covariance,
        lengths=LENGTHS,
        lengths_stddev=np.zeros_like(LENGTHS),
    )


def poses(count: int, seed: int = 3, share: float = 0.9) -> FloatArray:
    """(count, 35) within the ranges of motion, bases anywhere."""
    rng = np.random.default_rng(seed)
    v = np.empty((count, NV))
    v[:, :6] = rng.normal(size=(count, 6))
    v[:, 6:] = RANGES.centre + share * rng.uniform(-1, 1, size=(count, NV - 6)) * (RANGES.high - RANGES.centre)
    return MODEL.integrate(MODEL.neutral(), v)


def arms(flexion: float, abduction: float, rotation: float = 0.0, elbow: float = 0.0) -> FloatArray:
    """(35,) both arms alike, degrees; otherwise neutral."""
    v = np.zeros(NV)
    for side, _ in SIDES:
        v[MODEL.coordinate_names.index(f"elbow_flexion_{side}")] = elbow * DEGREE
    q = MODEL.integrate(MODEL.neutral(), v)
    for side, _ in SIDES:
        turns = [
            so3.exp(np.radians(t) * a) for t, a in zip((flexion, abduction, rotation), SHOULDER_AXES[side], strict=True)
        ]
        q[MODEL.quaternion_of(f"upper_arm_{side}")] = so3.quat_multiply(so3.quat_multiply(turns[0], turns[1]), turns[2])
    return q


def by_name(angles: JointAngles) -> dict[str, float]:
    return dict(zip(angles.names, angles.position.tolist(), strict=True))


def turn(axis: FloatArray, angle: float) -> FloatArray:
    matrix: FloatArray = Rotation.from_rotvec(angle * axis).as_matrix()
    return matrix


def rotations_of(q: FloatArray) -> dict[str, FloatArray]:
    return dict(zip(SEGMENTS, MODEL.forward(q, LENGTHS).rotations, strict=True))


# --- the conventions' own kinematics, written down once more: angles to rotations


def assert_model(q: FloatArray, a: dict[str, float]) -> None:
    r = rotations_of(q)
    np.testing.assert_allclose(
        r["pelvis"] @ turn(Y, a["trunk_flexion"]) @ turn(X, a["trunk_lateral"]) @ turn(Z, a["trunk_axial"]),
        r["upper_trunk"],
        atol=1e-9,
    )
    rebuilt = q.copy()
    for number, name in zip(MODEL.scalar_q, np.array(MODEL.coordinate_names)[MODEL.scalar_v], strict=True):
        rebuilt[number] = a[name]
    for side, s in SIDES:
        shoulder = (
            turn(-Y, a[f"shoulder_flexion_{side}"])
            @ turn(s * X, a[f"shoulder_abduction_{side}"])
            @ turn(-s * Z, a[f"shoulder_rotation_{side}"])
        )
        rebuilt[MODEL.quaternion_of(f"upper_arm_{side}")] = so3.matrix_to_quat(shoulder)
    np.testing.assert_allclose(
        MODEL.forward(rebuilt, LENGTHS).rotations, MODEL.forward(q, LENGTHS).rotations, rtol=0, atol=1e-9
    )


def assert_isb(q: FloatArray, a: dict[str, float]) -> None:
    """In ISB axes (X forward, Y up, Z right), left arms mirrored: z to -z."""
    r = rotations_of(q)
    to_isb = np.array([X, Z, -Y])  # rows: ISB axes in the segments' frames
    mirror = np.diag([1.0, 1.0, -1.0])

    def joint(parent: str, child: str, side: str = "right") -> FloatArray:
        relative: FloatArray = to_isb @ r[parent].T @ r[child] @ to_isb.T
        return mirror @ relative @ mirror if side == "left" else relative

    np.testing.assert_allclose(
        joint("pelvis", "upper_trunk"),
        turn(Z, a["thorax_extension"]) @ turn(X, a["thorax_lateral_right"]) @ turn(Y, a["thorax_axial_left"]),
        atol=1e-9,
    )
    np.testing.assert_allclose(
        joint("upper_trunk", "head"), turn(Z, a["neck_extension"]) @ turn(X, a["neck_lateral_right"]), atol=1e-9
    )
    for side, _ in SIDES:
        np.testing.assert_allclose(
            joint("upper_trunk", f"clavicle_{side}", side),
            turn(Y, a[f"clavicle_protraction_{side}"]) @ turn(X, a[f"clavicle_depression_{side}"]),
            atol=1e-9,
        )
        np.testing.assert_allclose(
            joint("upper_trunk", f"upper_arm_{side}", side),
            turn(Y, a[f"shoulder_plane_of_elevation_{side}"])
            @ turn(X, a[f"shoulder_elevation_{side}"])
            @ turn(Y, a[f"shoulder_internal_rotation_{side}"]),
            atol=1e-9,
        )
        # the bones of the forearm and the hand have their zero with the palm forward
        palm_forward = turn(Y, -np.pi / 2)
        np.testing.assert_allclose(
            joint(f"upper_arm_{side}", f"forearm_{side}", side) @ palm_forward.T,
            turn(Z, a[f"elbow_flexion_{side}"]) @ turn(Y, a[f"elbow_pronation_{side}"]),
            atol=1e-9,
        )
        np.testing.assert_allclose(
            palm_forward @ joint(f"forearm_{side}", f"hand_{side}", side) @ palm_forward.T,
            turn(Z, a[f"wrist_flexion_{side}"]) @ turn(X, a[f"wrist_ulnar_deviation_{side}"]),
            atol=1e-9,
        )


def assert_rep155(q: FloatArray, a: dict[str, float]) -> None:
    """Axes of human_description; the torso of its tree, then head and arms."""
    r = rotations_of(q)
    torso = r["pelvis"] @ turn(Y, a["waist"])
    assert abs((torso.T @ r["upper_trunk"] @ Z)[0]) < 1e-9  # only lateral and axial rotation remain
    np.testing.assert_allclose(
        torso @ turn(X, a["r_head"]) @ turn(Z, a["y_head"]) @ turn(-Y, a["p_head"]), r["head"], atol=1e-9
    )
    for side, s in SIDES:
        letter = side[0]
        upper_arm = (
            torso
            @ turn(-s * Z, a[f"{letter}_y_shoulder"])
            @ turn(s * X, a[f"{letter}_p_shoulder"])
            @ turn(s * Z, a[f"{letter}_r_shoulder"])
        )
        np.testing.assert_allclose(upper_arm, r[f"upper_arm_{side}"], atol=1e-9)
        forearm = upper_arm @ turn(-Y, a[f"{letter}_elbow"])
        np.testing.assert_allclose(forearm @ Z, r[f"forearm_{side}"] @ Z, atol=1e-9)


def assert_dh26(q: FloatArray, a: dict[str, float]) -> None:
    """Her forward kinematics puts her ten joints where ours are."""
    posture = MODEL.forward(q, LENGTHS)
    hers = Schlagenhauf26(q[:3], posture.rotations[0])
    ours = dict(zip(MODEL.joints.tolist(), posture.positions, strict=True))
    length = dict(zip(MODEL.length_names, LENGTHS, strict=True))
    names = ["lower_trunk", "upper_trunk"]
    names += [f"{bone}_{side}" for side, _ in SIDES for bone in ("clavicle", "upper_arm", "forearm", "hand")]
    lengths = np.array([length[n] + (length[n.replace("hand", "hand_tip")] if "hand" in n else 0.0) for n in names])
    theta = np.array([a[f"theta{i}"] for i in range(1, 27)])
    np.testing.assert_allclose(
        hers.forward(theta, lengths).positions, [ours[j] for j in hers.joints.tolist()], rtol=0, atol=1e-9
    )
    turned = dict(zip(hers.segment_names, hers.forward(theta, lengths).rotations, strict=True))
    for segment in ("lower_trunk", "upper_trunk", "upper_arm_left", "upper_arm_right"):
        np.testing.assert_allclose(turned[segment], rotations_of(q)[segment], rtol=0, atol=1e-9)
    assert [a[f"theta{i}"] for i in (9, 12, 16, 23)] == [0.0] * 4


REBUILT = {"model": assert_model, "isb": assert_isb, "rep155": assert_rep155, "dh26": assert_dh26}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_the_angles_rebuild_the_rotations(name: str) -> None:
    """Of people anywhere, and in the singular poses of the shoulders."""
    singular = ((0, 0), (0, 90), (90, 0), (180, 0), (0, 180), (90, 90), (-40, 0))
    for q in (*poses(draws(30, 100)), *(arms(*pose, rotation=20.0, elbow=50.0) for pose in singular)):
        angles = angles_of(estimate(q), MODEL, name)
        assert np.isfinite(angles.position).all()
        REBUILT[name](q, by_name(angles))


OWN = ((0, 0, 0, 0), (0, 90, 0, 0), (90, 0, 0, 0), (170, 0, 0, 0), (0, 170, 0, 0), (-40, 0, 0, 90), (0, 30, 50, 90))
ISB = ("shoulder_plane_of_elevation", "shoulder_elevation", "shoulder_internal_rotation", "elbow_flexion")
REP155 = ("y_shoulder", "p_shoulder", "r_shoulder", "elbow")
HERS = tuple(f"theta{number}" for number in (13, 14, 15, 16, 17, 20, 24))


@pytest.mark.parametrize(
    ("convention", "keys", "pose", "values"),
    [("model", (*OUTER_OF_MODEL, "elbow_flexion"), pose, pose) for pose in OWN]
    + [
        ("isb", ISB, (0, 0, 0, 0), (0, 0, 0, 0)),  # hanging
        ("isb", ISB, (0, 90, 0, 0), (0, -90, 0, 0)),  # abduction: plane 0
        ("isb", ISB, (90, 0, 0, 90), (90, -90, -90, 90)),  # forward flexion: plane 90
        ("isb", ISB, (-40, 0, 0, 0), (-90, -40, 90, 0)),  # extension
        ("isb", ISB, (0, 45, 30, 90), (0, -45, 30, 90)),  # internal rotation positive
        ("rep155", REP155, (0, 0, 0, 0), (0, 0, 0, 0)),
        ("rep155", REP155, (0, 90, 0, 0), (0, 90, 0, 0)),
        ("rep155", REP155, (90, 0, 0, 90), (90, 90, 90, 90)),
        ("rep155", REP155, (0, 60, 0, 45), (0, 60, 0, 45)),
        ("dh26", HERS, (0, 90, 0, 0), (0, 0, 0, 0, 0, 0, 0)),  # the T-pose
        ("dh26", HERS, (0, 0, 0, 0), (90, 0, 0, 0, 0, -90, 0)),
        ("dh26", HERS, (0, 90, 0, 60), (0, 0, 0, 0, -60, 0, 60)),
    ],
)
def test_textbook_poses(convention: str, keys: tuple[str, ...], pose: tuple[int, ...], values: tuple[int, ...]) -> None:
    """Degrees of both arms; all other angles are zero but the ISB's pronation, which is 90 with thumbs forward."""
    for label, angle in by_name(angles_of(estimate(arms(*pose)), MODEL, convention)).items():
        key = label[2:] if label[2:] in keys else label.removesuffix("_left").removesuffix("_right")
        known = dict(zip(keys, values, strict=True))
        rest = 90.0 if key == "elbow_pronation" else 0.0
        assert np.degrees(angle) == pytest.approx(known.get(key, rest), abs=1e-6), label


def _away_from_singular(name: str, count: int, stddev: float) -> list[FloatArray]:
    """Poses in which all angles but the redundant ones are well determined."""
    chosen = []
    for q in poses(40 * count, seed=17, share=0.5):
        stddevs = angles_of(estimate(q, stddev), MODEL, name).position_stddev
        if (stddevs[np.isfinite(stddevs)] < 5.0 * stddev).all() and np.isinf(stddevs).sum() == 4 * (name == "dh26"):
            chosen.append(q)
        if len(chosen) == count:
            return chosen
    raise AssertionError(f"{name}: only {len(chosen)} poses")


@pytest.mark.parametrize("name", CONVENTIONS)
def test_rates_and_standard_deviations_are_those_of_differences(name: str) -> None:
    step = 1e-6
    for q in _away_from_singular(name, draws(2, 4), 1e-6):
        now = angles_of(estimate(q), MODEL, name)
        columns = []
        for direction in np.eye(NV):
            plus, minus = (
                angles_of(estimate(MODEL.integrate(q, s * step * direction)), MODEL, name, now).position
                for s in (1.0, -1.0)
            )
            columns.append((plus - minus) / (2.0 * step))
        jacobian = np.stack(columns, axis=-1)
        rng = np.random.default_rng(2)
        velocity = rng.normal(size=NV)
        root = rng.normal(size=(2 * NV, 2 * NV))
        covariance = 1e-12 * root @ root.T
        angles = angles_of(estimate(q, velocity=velocity, covariance=covariance), MODEL, name)
        np.testing.assert_allclose(angles.velocity, jacobian @ velocity, rtol=0, atol=1e-7)
        known = np.isfinite(angles.position_stddev)
        for stddev, block in (
            (angles.position_stddev, covariance[:NV, :NV]),
            (angles.velocity_stddev, covariance[NV:, NV:]),
        ):
            expected = np.sqrt(np.einsum("ik,kl,il->i", jacobian, block, jacobian))
            np.testing.assert_allclose(stddev[known], expected[known], rtol=1e-6)


SINGULAR = {"model": (0.0, 90.0), "isb": (0.0, 0.0), "rep155": (0.0, 0.0), "dh26": (90.0, 0.0)}
OUTER = {
    "model": tuple(f"{name}_left" for name in OUTER_OF_MODEL),
    "isb": ("shoulder_plane_of_elevation_left", "shoulder_elevation_left", "shoulder_internal_rotation_left"),
    "rep155": ("l_y_shoulder", "l_p_shoulder", "l_r_shoulder"),
    "dh26": ("theta13", "theta14", "theta15"),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_the_standard_deviation_grows_towards_a_singular_pose(name: str) -> None:
    """Deviations of the outer angles grow towards the singular pose without bound; the middle one's does not change."""
    stddev, before = 0.5 * DEGREE, 0.0
    flexion, abduction = SINGULAR[name]
    for away in (40.0, 20.0, 10.0, 6.0, 1.0, 0.0):
        # flexion is the model's first angle, and does not lead away from its singular pose
        q = arms(flexion, abduction - away) if name == "model" else arms(flexion - away, abduction + 0.1)
        angles = angles_of(estimate(q, stddev), MODEL, name)
        first, middle, last = (angles.names.index(key) for key in OUTER[name])
        deviations = angles.position_stddev
        assert deviations[middle] < 5.0 * stddev
        assert max(deviations[first], deviations[last]) <= UNIFORM_STDDEV and np.isfinite(angles.velocity_stddev[first])
        assert deviations[first] > before or away == 0.0
        assert (deviations[first] > 30.0 * stddev) == (away < 2.0)
        before = deviations[first]


@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5, 0.7])
def test_near_a_singular_pose_95_percent_are_within_1_96_deviations(ratio: float) -> None:
    """To first order they are not: at a deviation of 40 degrees errors of 110 were stated to be impossible."""
    stddev = 5.0 * DEGREE
    away = np.degrees(np.arcsin(stddev / ratio))
    angles = angles_of(estimate(arms(0.0, 90.0 - away), stddev), MODEL, "model")
    first, middle, last = (angles.position_stddev[angles.names.index(key)] for key in OUTER["model"])
    direction = np.random.default_rng(1).normal(size=(200_000, 2)) + (1.0 / ratio, 0.0)
    half_width = np.quantile(np.abs(np.arctan2(direction[:, 1], direction[:, 0])), 0.95)
    np.testing.assert_allclose((1.96 * first, middle), (half_width, stddev), rtol=0.05)
    assert last > 0.95 * first


def _path(kind: str, offset: float) -> list[FloatArray]:
    """An arm that swings through a pose and a little past it, degrees per step at most 3."""
    steps = np.arange(-60.0, 15.0 if kind == "up" else 60.1, 3.0)  # an arm does not go far behind straight up
    if kind == "hanging":
        return [arms(t, offset) for t in steps]
    if kind == "t_pose":
        return [arms(offset, 90.0 + t) for t in steps]
    if kind == "up":
        return [arms(180.0 + t, offset) for t in steps]
    return [arms(90.0 + t, offset, 30.0) for t in steps]  # forward


def test_an_arm_that_passed_behind_its_t_pose_gets_its_usual_angles_back() -> None:
    """Noise decides on which side of the singular pose an arm leaves it; the angles may not stay -75, 163, -150 deg."""
    path = np.concatenate(
        [np.linspace((0.0, 92.0, 0.0), (-75.0, 163.0, -150.0), 40), np.full((30, 3), (-75, 163, -150))]
    )
    before: JointAngles | None = None
    found = []
    for triple in path:
        before = angles_of(estimate(arms(*triple), 3.0 * DEGREE), MODEL, "model", before)
        columns = [before.names.index(f"shoulder_{each}_left") for each in ("flexion", "abduction", "rotation")]
        found.append(np.degrees([before.position[columns], before.position_stddev[columns]]))
    positions, stddevs = np.array(found).swapaxes(0, 1)
    np.testing.assert_allclose(positions[-1], (105.0, 17.0, 30.0), atol=1.0)
    assert stddevs[-1].max() < 30.0
    jumps = np.flatnonzero(np.abs(np.diff(positions, axis=0)).max(axis=1) > 60.0)
    assert len(jumps) == 1
    assert stddevs[jumps[0], [0, 2]].min() > 60.0  # the deviations have said so before


@pytest.mark.parametrize("name", CONVENTIONS)
@pytest.mark.parametrize("kind", ["hanging", "t_pose", "up", "forward"])
@pytest.mark.parametrize("offset", some([-2.0, 0.0, 0.5]))
def test_angles_are_continuous_through_singular_poses(name: str, kind: str, offset: float) -> None:
    """An arm that moves by 3 deg a frame, known to 3 deg.

    No angle takes steps of more than five times that (past a singular pose at 2 deg an exact split takes 74 deg in one
    step), and the angles together do not stray from the rotation by more than three standard deviations.
    """
    before: JointAngles | None = None
    for q in _path(kind, offset):
        angles = angles_of(estimate(q, 3.0 * DEGREE), MODEL, name, before)
        assert np.isfinite(angles.position).all()
        if before is not None:
            step = np.degrees(np.abs(angles.position - before.position))
            assert step.max() < 15.0, [(n, s) for n, s in zip(angles.names, step, strict=True) if s > 5]
        if name == "model":
            for side, _ in SIDES:
                a = by_name(angles)
                t = [a[f"shoulder_{k}_{side}"] for k in ("flexion", "abduction", "rotation")]
                built = np.linalg.multi_dot([turn(axis, x) for axis, x in zip(SHOULDER_AXES[side], t, strict=True)])
                r = rotations_of(q)
                error = Rotation.from_matrix(built.T @ r[f"clavicle_{side}"].T @ r[f"upper_arm_{side}"]).magnitude()
                assert np.degrees(error) < 9.0
        before = angles


def test_an_arm_that_noise_rotates_beyond_its_range_keeps_its_direction() -> None:
    """Seen on a real pair of Kinects (p07_45deg): abduction of a hanging arm went from -34 to 213 deg."""
    before: JointAngles | None = None
    for rotation in np.arange(0.0, -400.0, -5.0):
        before = angles_of(estimate(arms(20.0, -34.0, rotation), 8.0 * DEGREE), MODEL, "model", before)
        values = by_name(before)
        for side, _ in SIDES:
            shoulder = np.degrees([values[f"shoulder_flexion_{side}"], values[f"shoulder_abduction_{side}"]])
            np.testing.assert_allclose(shoulder, [20.0, -34.0], atol=1e-6)


@pytest.mark.parametrize("known", [8.0, 24.0])
def test_an_arm_that_hangs_is_not_flexed_and_abducted_by_180_degrees(known: float) -> None:
    """Seen on a real pair of Kinects (p02_90deg), the rotation of a straight arm far outside its range.

    576 of 3,035 frames had angles such as (172, 170, 0) degrees for (-8, 10, 180), from an absence of the arm on.
    """
    before: JointAngles | None = None
    for first in (None, (172.0, 170.0, 0.0)):
        if first is not None:
            before = angles_of(estimate(arms(*first), known * DEGREE), MODEL, "model", before)
        before = angles_of(estimate(arms(-8.0, 10.0, 180.0), known * DEGREE), MODEL, "model", before)
        values = by_name(before)
        for side, _ in SIDES:
            shoulder = np.degrees([values[f"shoulder_flexion_{side}"], values[f"shoulder_abduction_{side}"]])
            np.testing.assert_allclose(shoulder, [-8.0, 10.0], atol=1e-6)


def test_the_deviation_announces_a_jump_back_into_the_usual_ranges() -> None:
    """An arm that swings through hanging and on by 90 deg, farther than its elevation stays positive."""
    before: JointAngles | None = None
    jumps = 0
    for flexion in np.arange(50.0, -90.1, -3.0):
        angles = angles_of(estimate(arms(flexion, 0.5), 3.0 * DEGREE), MODEL, "isb", before)
        if before is not None:
            jumped = np.abs(angles.position - before.position) > 60.0 * DEGREE
            jumps += int(jumped.sum())
            assert (before.position_stddev[jumped] > 60.0 * DEGREE).all()
        before = angles
    assert jumps > 0


@pytest.mark.parametrize("name", CONVENTIONS)
def test_rates_of_held_angles_are_the_derivatives_of_the_held_angles(name: str) -> None:
    """One degree from the singular pose, known to 3 deg: the first angle is held, the last takes the whole turn."""
    q = arms(SINGULAR[name][0] + 0.6, SINGULAR[name][1] - 0.8)
    rng = np.random.default_rng(5)
    velocity = np.concatenate([np.zeros(6), rng.normal(size=NV - 6)])
    now = angles_of(estimate(q, 3.0 * DEGREE, velocity), MODEL, name)
    step = 1e-6
    after, earlier = (
        angles_of(estimate(MODEL.integrate(q, s * step * velocity), 3.0 * DEGREE), MODEL, name, now).position
        for s in (1.0, -1.0)
    )
    first, _, last = (now.names.index(key) for key in OUTER[name])
    # held at a value that is the rotation's to a degree or so: the rates are exact to that
    np.testing.assert_allclose(now.velocity, (after - earlier) / (2.0 * step), rtol=0, atol=0.05)
    assert abs(now.velocity[first]) < 0.05
    assert abs(now.velocity[last]) > 0.1


@pytest.mark.parametrize("name", CONVENTIONS)
def test_noise_does_not_spin_an_arm_at_a_singular_pose(name: str) -> None:
    """Some seconds of a person who keeps the pose, with the noise that the filter states."""
    rng = np.random.default_rng(3)
    pose = arms(*SINGULAR[name])
    before: JointAngles | None = None
    seen = []
    for _ in range(draws(100, 300)):
        q = MODEL.integrate(pose, np.concatenate([np.zeros(6), rng.normal(0.0, 1.5 * DEGREE, NV - 6)]))
        before = angles_of(estimate(q, 1.5 * DEGREE), MODEL, name, before)
        seen.append(before.position)
    spread = np.degrees(np.ptp(np.array(seen), axis=0))
    columns = [before.names.index(key) for key in OUTER[name]] if before is not None else []
    assert spread[columns].max() < 60.0


def test_an_unobserved_angle_has_the_deviation_of_its_prior() -> None:
    """The prior's deviation is published; an infinite one means that there is no estimate at all."""
    prior = PosturePrior(MODEL, RANGES)
    covariance = np.diag(np.append(np.zeros(6), prior.stddev**2).tolist() + [0.0] * NV)
    angles = angles_of(estimate(poses(1)[0], covariance=covariance), MODEL, "model")
    for name in ("thoracic_axial", "neck_flexion", "forearm_pronation_left"):
        number = MODEL.coordinate_names.index(name)
        assert angles.position_stddev[angles.names.index(name)] == pytest.approx(prior.stddev[number - 6])
    assert np.isfinite(angles.position_stddev).all()


def test_infinite_variances_and_missing_velocities_affect_their_angles_only() -> None:
    number = MODEL.coordinate_names.index("lumbar_axial")
    covariance = 1e-6 * np.eye(2 * NV)
    covariance[number, number] = np.inf
    velocity = np.zeros(NV)
    velocity[number] = np.nan
    angles = angles_of(estimate(poses(1)[0], velocity=velocity, covariance=covariance), MODEL, "model")
    told_stddev = dict(zip(angles.names, angles.position_stddev, strict=True))
    assert {key for key, value in told_stddev.items() if np.isinf(value)} == {
        "lumbar_axial",
        "trunk_flexion",
        "trunk_lateral",
        "trunk_axial",
    }
    np.testing.assert_array_equal(np.isnan(angles.velocity), np.isinf(angles.position_stddev))


def test_unknown_conventions_and_other_previous_angles_raise() -> None:
    now = estimate(MODEL.neutral())
    with pytest.raises(ConventionError, match="'euler', expected one of model, isb, rep155, dh26"):
        angles_of(now, MODEL, "euler")
    with pytest.raises(ConventionError, match="previous angles"):
        angles_of(now, MODEL, "isb", angles_of(now, MODEL, "model"))


def test_names_and_stamp() -> None:
    for name, count in (("model", 29), ("isb", 23), ("rep155", 12), ("dh26", 26)):
        angles = angles_of(estimate(MODEL.neutral()), MODEL, name)
        assert angles.stamp_ns == 7
        assert len(set(angles.names)) == count
        assert all(getattr(angles, field).shape == (count,) for field in ("position", "velocity", "position_stddev"))
