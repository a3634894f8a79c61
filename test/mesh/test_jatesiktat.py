"""The published method of Jatesiktat et al. (2018): the mesh walk, the correspondences, and the fit."""

from __future__ import annotations

import numpy as np
import pytest

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray, IntArray, Joint
from body_tracking.mesh import body_model, jatesiktat, raster
from body_tracking.mesh.body_model import Pose
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.jatesiktat import JatesiktatFitter, moving_average
from body_tracking.mesh.mesh_walk import SurfacePoints, neighbours, random_points, rematched, walk
from body_tracking.mesh.skinning import vertex_normals
from body_tracking.mesh.solver import MeshFitter
from body_tracking.mesh.uncertainty import kinect_landmarks

CAMERA = Camera("camera", 256, 212, np.array([[183.0, 0.0, 128.0], [0.0, 183.0, 106.0], [0.0, 0.0, 1.0]]), np.zeros(5))
ARMS = [
    (f"{side}_{name}", Joint[f"{name.upper()}_{side.upper()}"])
    for side in ("left", "right")
    for name in ("shoulder", "elbow", "wrist")
]


def grid(rng: np.random.Generator, size: int = 8) -> tuple[FloatArray, IntArray]:
    """An uneven flat mesh of the unit square in the plane z = 0."""
    steps = np.linspace(0.0, 1.0, size)
    points = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    inner = ((points > 0.0) & (points < 1.0)).all(axis=1)
    points[inner] += rng.uniform(-0.3, 0.3, (inner.sum(), 2)) / size
    number = np.arange(size * size).reshape(size, size)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([d, c, b])])
    return np.column_stack([points, np.zeros(len(points))]), faces.astype(np.intp)


def steps_of(vertices: FloatArray, faces: IntArray, points: SurfacePoints, vectors: FloatArray) -> FloatArray:
    """(n, 2) changes of u and v that move points by vectors (n, 3) in the planes of their faces."""
    corners = vertices[faces[points.faces]]
    sides = np.stack([corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 2]], axis=2)
    return np.array([np.linalg.lstsq(one, vector, rcond=None)[0] for one, vector in zip(sides, vectors, strict=True)])


# --- points that move over a mesh


def test_a_walk_over_a_flat_mesh_is_a_straight_line() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = grid(rng)
    points = random_points(vertices, faces, np.ones(len(faces)), 200, rng)
    target = np.column_stack([rng.uniform(0.05, 0.95, (200, 2)), np.zeros(200)])
    vectors = target - points.places(vertices, faces)
    moved = walk(faces, neighbours(faces), vertices, *points, steps_of(vertices, faces, points, vectors))
    np.testing.assert_allclose(SurfacePoints(*moved).places(vertices, faces), target, atol=1e-9)
    assert SurfacePoints(*moved).weights().min() > -1e-9


def test_a_walk_over_an_edge_goes_on_as_if_it_were_unfolded() -> None:
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    folded = flat.copy()
    folded[3] = [0.0, 0.0, -1.0]  # about the x axis
    faces = np.array([[0, 1, 2], [1, 0, 3]], dtype=np.intp)
    point = SurfacePoints(np.array([0]), np.array([[0.5, 0.2]]))
    step = steps_of(flat, faces, point, np.array([[-0.1, -0.5, 0.0]]))
    ends = [
        SurfacePoints(*walk(faces, neighbours(faces), mesh, *point, step)).places(mesh, faces)[0]
        for mesh in (flat, folded)
    ]
    np.testing.assert_allclose(ends[0], [0.1, -0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(ends[1], [0.1, 0.0, -0.2], atol=1e-12)


def test_a_walk_ends_where_the_mesh_does() -> None:
    rng = np.random.default_rng(1)
    vertices, faces = grid(rng)
    points = random_points(vertices, faces, np.ones(len(faces)), 50, rng)
    steps = steps_of(vertices, faces, points, np.tile([3.0, 0.0, 0.0], (50, 1)))
    ends = SurfacePoints(*walk(faces, neighbours(faces), vertices, *points, steps)).places(vertices, faces)
    np.testing.assert_allclose(ends[:, 0], 1.0, atol=1e-9)
    np.testing.assert_allclose(ends[:, 1], points.places(vertices, faces)[:, 1], atol=1e-9)


def test_neighbours_share_two_corners_and_know_each_other() -> None:
    faces = body_model.load().faces
    across = neighbours(faces)
    rows, corners = np.nonzero(across >= 0)
    for face, corner in zip(rows[::37], corners[::37], strict=True):
        other = across[face, corner]
        assert set(np.delete(faces[face], corner)) <= set(faces[other]) and face in across[other]


def test_a_correspondence_is_never_worse_than_any_candidate_or_any_neighbour() -> None:
    rng = np.random.default_rng(2)
    model = body_model.load()
    normals = vertex_normals(model.vertices, model.faces)
    candidates = random_points(model.vertices, model.faces, np.ones(len(model.faces)), 100, rng)
    start = random_points(model.vertices, model.faces, np.ones(len(model.faces)), 40, rng)
    truth = random_points(model.vertices, model.faces, np.ones(len(model.faces)), 40, rng)
    points, wanted = truth.places(model.vertices, model.faces), truth.normals(normals, model.faces)

    def costs(of: SurfacePoints, at: int | slice = slice(None)) -> FloatArray:
        places = of.places(model.vertices, model.faces) - points[at]
        turns = of.normals(normals, model.faces) - wanted[at]
        return np.asarray((places**2).sum(axis=1) / 0.003**2 + (turns**2).sum(axis=1) / 0.25**2)

    across = neighbours(model.faces)
    found = SurfacePoints(
        *rematched(
            *(model.faces, across, model.vertices, normals, points, wanted, *start, *candidates),
            *(1.0 / 0.003, 1.0 / 0.25),
        )
    )
    own = costs(found)
    assert np.all(own <= costs(start) + 1e-9)
    for n in range(len(points)):
        assert own[n] <= costs(candidates, n).min() + 1e-9
        around = across[found.faces[n]]
        centres = SurfacePoints(around[around >= 0], np.full(((around >= 0).sum(), 2), 1.0 / 3.0))
        assert own[n] <= costs(centres, n).min() + 1e-9


# --- the fit


@pytest.fixture(scope="module")
def fitter() -> JatesiktatFitter:
    return JatesiktatFitter(body_model.load().body())


def posed(elevation: float = 0.7, flexion: float = 0.6) -> Pose:
    return MeshFitter(body_model.load().body()).neutral(np.array([0.1, 0.1, 2.3]), elevation, flexion)


def kinect_joints(pose: Pose) -> FloatArray:
    body = body_model.load().body()
    marks, at = kinect_landmarks(body), body.posed(pose)
    return (
        np.einsum("nab,nb->na", at.turned[marks.bones], marks.places - body.joints[marks.bones])
        + at.placed[marks.bones]
    )


def frame_of(fitter: JatesiktatFitter, pose: Pose) -> jatesiktat.Frame:
    depth = raster.render(fitter.body.posed(pose).vertices, fitter.body.model.faces, CAMERA).depth
    mask = depth > 0.0
    noisy = np.where(mask, depth + 2e-3 * np.random.default_rng(3).normal(size=depth.shape), 4.0).astype(np.float32)
    return fitter.frame(DepthCamera(CAMERA), noisy, mask, kinect_joints(pose))


def off(fitter: JatesiktatFitter, theta: FloatArray, pose: Pose) -> FloatArray:
    """(6,) metres of the arms' joints."""
    numbers = [fitter.body.model.index(name) for name, _ in ARMS]
    difference = fitter.body.posed(fitter.pose(theta)).placed - fitter.body.posed(pose).placed
    return np.asarray(np.linalg.norm(difference[numbers], axis=1))


def test_the_start_replicates_a_kinects_skeleton(fitter: JatesiktatFitter) -> None:
    pose = posed(1.2, 0.8)
    assert len(fitter.kinect_start(kinect_joints(pose))) == 37
    # SpineShoulder is between the collar bones, where the model's collars turn
    assert off(fitter, fitter.kinect_start(kinect_joints(pose)), pose).max() < 0.03


def test_the_start_of_a_skeleton_without_arms_has_those_of_the_rest_pose(fitter: JatesiktatFitter) -> None:
    joints = kinect_joints(posed())
    joints[[joint for _, joint in ARMS]] = np.nan
    theta = fitter.kinect_start(joints)
    assert np.isfinite(theta).all() and not theta[21:].any()


def test_the_fit_finds_a_pose_from_a_kinects_wrong_skeleton(fitter: JatesiktatFitter) -> None:
    pose = posed()
    frame = frame_of(fitter, pose)
    start = fitter.kinect_start(kinect_joints(posed(0.55, 0.8)) + 0.01)
    found = fitter.fit(frame, [start])
    assert off(fitter, start, pose).mean() > 0.04
    assert off(fitter, found.theta, pose).mean() < 0.02


@pytest.mark.slow
def test_the_fit_from_several_starts_is_the_best_of_them() -> None:
    brief = JatesiktatFitter(body_model.load().body(), jatesiktat.Configuration(iterations=3))
    frame = frame_of(brief, posed())
    far, near = (
        brief.kinect_start(kinect_joints(posed(*arms)) + by) for arms, by in (((1.5, 0.1), 0.2), ((0.55, 0.8), 0.01))
    )
    alone, worse, both = (brief.fit(frame, starts).energy for starts in ([near], [far], [far, near]))
    assert both == pytest.approx(alone) and alone < worse


def test_jacobians_are_the_derivatives_of_the_residuals(fitter: JatesiktatFitter) -> None:
    frame = frame_of(fitter, posed())
    theta = fitter.kinect_start(kinect_joints(posed(0.6, 0.7)))
    rng = np.random.default_rng(4)
    count = len(frame.points)
    matches = random_points(fitter.body.vertices, fitter._faces, np.ones(len(fitter._faces)), count, rng)
    at = fitter.body.posed(fitter.pose(theta))
    selected = jatesiktat._Selected(fitter._selected(at), None, None)
    by_pose, by_match = fitter._jacobian(theta, matches, frame, selected, {}, at)
    assert by_pose.shape[1] == 37 and by_match.shape == (count, 6, 2)
    for axis in range(2):
        step = np.zeros((count, 2))
        step[:, axis] = 1e-6
        ends = [
            fitter.residuals(theta, SurfacePoints(matches.faces, matches.shares + sign * step), frame, selected, {})
            for sign in (1.0, -1.0)
        ]
        difference = (ends[0] - ends[1])[: 6 * count] / 2e-6
        places, normals = difference[: 3 * count].reshape(count, 3), difference[3 * count :].reshape(count, 3)
        np.testing.assert_allclose(by_match[:, :, axis], np.concatenate([places, normals], axis=1), atol=1e-4)


def test_the_step_solves_the_damped_normal_equations() -> None:
    rng = np.random.default_rng(5)
    count, pose = 6, 5
    by_pose, by_match = rng.normal(size=(6 * count + 4, pose)), rng.normal(size=(count, 6, 2))
    residuals = rng.normal(size=6 * count + 4)
    dense = np.zeros((6 * count + 4, pose + 2 * count))
    dense[:, :pose] = by_pose
    for n in range(count):
        dense[3 * n : 3 * n + 3, pose + 2 * n : pose + 2 * n + 2] = by_match[n, :3]
        rows = 3 * count + 3 * n
        dense[rows : rows + 3, pose + 2 * n : pose + 2 * n + 2] = by_match[n, 3:]
    expected = np.linalg.solve(dense.T @ dense + 7.0 * np.eye(dense.shape[1]), -dense.T @ residuals)
    turn, shift = jatesiktat._step(by_pose, by_match, residuals, 7.0)
    np.testing.assert_allclose(np.concatenate([turn, shift.ravel()]), expected, atol=1e-10)


def test_a_forearms_direction_is_all_that_an_imu_gives(fitter: JatesiktatFitter) -> None:
    frame = frame_of(fitter, posed())
    theta = fitter.kinect_start(kinect_joints(posed()))
    at = fitter.body.posed(fitter.pose(theta))
    elbow, wrist = (fitter.body.model.index(f"left_{name}") for name in ("elbow", "wrist"))
    along = (at.placed[wrist] - at.placed[elbow]) / np.linalg.norm(at.placed[wrist] - at.placed[elbow])
    selected = jatesiktat._Selected(fitter._selected(at), None, None)
    matches = SurfacePoints(np.zeros(len(frame.points), np.intp), np.full((len(frame.points), 2), 1.0 / 3.0))
    for direction, expected in ((along, 0.0), (-along, 4.0 * fitter.configuration.imu)):
        residuals = fitter.residuals(theta, matches, frame, selected, {"left": direction})[-3:]
        assert residuals @ residuals == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_the_rough_shape_has_the_lengths_of_the_skeleton() -> None:
    model = body_model.load()
    rng = np.random.default_rng(6)
    person = model.body(rng.normal(size=model.vertex_shapes.shape[2]))
    marks = kinect_landmarks(person)
    found = kinect_landmarks(model.body(jatesiktat.rough_shape(model, marks.places)))
    mean = kinect_landmarks(model.body())
    pairs = [
        (Joint.SHOULDER_LEFT, Joint.ELBOW_LEFT),
        (Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT),
        (Joint.HEAD, Joint.ANKLE_LEFT),
    ]

    def lengths(places: FloatArray) -> FloatArray:
        return np.array([np.linalg.norm(places[one] - places[other]) for one, other in pairs])

    assert np.abs(lengths(found.places) - lengths(marks.places)).max() < 0.005
    assert np.abs(lengths(mean.places) - lengths(marks.places)).max() > 0.01


def test_the_moving_average_is_of_three_images_and_keeps_a_straight_course() -> None:
    course = np.outer(np.arange(6.0), [1.0, 2.0])
    np.testing.assert_allclose(moving_average(course)[1:-1], course[1:-1])
    single = np.zeros((5, 1))
    single[2] = 3.0
    np.testing.assert_allclose(moving_average(single)[:, 0], [0.0, 1.0, 1.0, 1.0, 0.0])
