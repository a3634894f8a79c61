"""A person is tracked through depth images, and the loss of the person is detected."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from depth_recording import recording

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.compiled import LOOPS
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, TrackingState
from body_tracking.mesh import body_model
from body_tracking.mesh.body_index import NO_BODY
from body_tracking.mesh.depth import DepthCamera, DepthError, to_metres
from body_tracking.mesh.person import COVERED, NOBODY, PersonFinder
from body_tracking.mesh.raster import render
from body_tracking.mesh.solver import MeshFitter, facing
from body_tracking.mesh.tracking import MeshTracker, Tracked, prepare
from draws import some

ARMS = [getattr(Joint, f"{name}_{side}") for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
STAMPS = [*recording().images]
NOTHING = np.zeros_like(recording().images[STAMPS[0]])


@pytest.fixture(autouse=True, scope="module")
def _prepared() -> None:
    prepare()


@pytest.fixture
def tracker() -> MeshTracker:
    """A tracker of an unknown person."""
    body = body_model.load().body()
    return MeshTracker(DepthCamera(recording().camera), body, np.eye(len(body.shape)))


def tracked(tracker: MeshTracker, numbers: range) -> list[Tracked | None]:
    return [tracker.update(STAMPS[number], recording().images[STAMPS[number]]) for number in numbers]


def off(found: Tracked) -> FloatArray:
    """(6, 3) metres."""
    return (found.points - recording().joints[found.stamp_ns])[ARMS]


def test_no_image_after_the_preparation_waits_for_the_compiler(tracker: MeshTracker) -> None:
    before = [len(loop.signatures) for loop in LOOPS]
    assert any(before)
    assert all(tracked(tracker, range(3)))
    assert [len(loop.signatures) for loop in LOOPS] == before


def test_arms_of_an_unknown_person_are_nearer_to_the_truth_than_a_kinects_and_within_their_covariance(
    tracker: MeshTracker,
) -> None:
    found = tracked(tracker, range(0, 120, 3))
    assert all(found)
    assert tracker.counters["second starts"] <= 2 and not tracker.counters["lost"]
    errors = np.array([off(each) for each in found if each])
    kinect = np.array([(recording().kinect[s] - recording().joints[s])[ARMS] for s in STAMPS[:120:3]])
    assert np.linalg.norm(errors, axis=2).mean() < min(0.032, np.linalg.norm(kinect, axis=2).mean())  # 28 and 39 mm
    covariances = np.array([each.covariance[ARMS] for each in found if each])
    nees = np.einsum("tna,tnab,tnb->tn", errors, np.linalg.inv(covariances), errors) / 3.0
    # one person, whose shape errs the same way in all images and is near the mean: wider than the 0.5 to 2 over many
    assert 0.1 < nees.mean() < 2.5
    skeletons = [each.skeleton("camera") for each in found if each]
    assert all(each.covariances is not None for each in skeletons)
    # the legs' surface is seen as well; hands and feet of unknown people are not known well
    ends = [joint for joint in Joint if not joint.name.startswith(("HAND", "THUMB", "FOOT"))]
    assert np.mean([each.states[ends] == TrackingState.TRACKED for each in skeletons]) > 0.9


def test_an_arm_that_comes_to_point_at_the_camera_is_followed(tracker: MeshTracker) -> None:
    """With hanging arms as the mean of ordinary postures the right arm stayed down, 0.9 m off; all points fitted."""
    found = tracked(tracker, range(180, 220))
    assert all(found)
    wrists = np.array([np.linalg.norm(off(each), axis=1)[[2, 5]] for each in found if each])
    assert wrists.max() < 0.25


def test_a_covered_lens_is_reported_and_the_person_is_found_again_at_once(tracker: MeshTracker) -> None:
    tracked(tracker, range(3))
    # within predict_for the pose is still expected
    for number in range(3, 9):
        assert tracker.update(STAMPS[number], NOTHING) is None
        assert tracker.problem == COVERED and not tracker.state()["tracked"]
    assert all(tracked(tracker, range(9, 12)))
    assert tracker.counters["searches"] == 1 and tracker.counters[COVERED] == 6
    # after that the person is searched for anew
    for number in range(12, 30):
        assert tracker.update(STAMPS[number], NOTHING) is None
    assert tracker.counters["people lost"] == 1
    found = tracked(tracker, range(30, 32))
    assert found[0] and tracker.counters["searches"] == 2
    assert np.linalg.norm(off(found[0]), axis=1).mean() < 0.1
    assert tracker.state()["tracked"]


def test_furniture_of_a_persons_size_is_lost_and_searches_take_turns_in_time(tracker: MeshTracker) -> None:
    height, width = NOTHING.shape
    image = np.full_like(NOTHING, 4.0)
    image[height // 4 : -height // 4, 2 * width // 5 : -2 * width // 5] = 2.2
    found = [tracker.update(k * NANOSECONDS // 30, image) for k in range(9)]
    assert not any(found)
    # every 0.2 s, for a search takes as long as ten images
    assert tracker.counters["searches"] == 2 and tracker.counters["lost"] == 2
    assert tracker.problem == "searching"


def test_a_person_who_walks_across_is_found_from_the_side_at_once_and_the_right_way_round() -> None:
    """Starts that face the camera find such a person in the end, and lose them in between."""
    body, wall, right = body_model.load().body(), np.full_like(NOTHING, 4.0), []
    for side, elevation, flexion in some(list(itertools.product((-1.0, 1.0), (0.1, 0.15), (0.2, 0.4)))):
        tracker = MeshTracker(DepthCamera(recording().camera), body, np.eye(len(body.shape)))
        fitter = MeshFitter(body)
        tracker.update(0, wall)
        for number in range(1, 13):
            pose = fitter.neutral(np.array([side * (1.5 - 0.9 * number / 15), 0.0, 2.2]), elevation, flexion)
            pose.rotations[0] = facing(np.array([-side, 0.0, 0.0]))
            person = render(body.posed(pose).vertices, body.model.faces, recording().camera).depth
            found = tracker.update(round(number / 15 * NANOSECONDS), np.where(person > 0.0, person, wall))
            if found is not None:
                across = found.points[Joint.SHOULDER_LEFT] - found.points[Joint.SHOULDER_RIGHT]
                assert abs(np.degrees(np.arctan2(across[0], -side * across[2]))) < 30.0
            if number > 3:
                right.append(found is not None)
    assert np.mean(right) > 0.95


@pytest.mark.parametrize("size", some([-3.0, -1.5, 0.0, 2.0]))
def test_people_of_1_4_to_1_9_m_are_found_by_the_mean_body_or_a_smaller_one(tracker: MeshTracker, size: float) -> None:
    model, wall = tracker.body.model, np.full_like(NOTHING, 4.0)
    body = model.body(size * np.eye(len(tracker.body.shape))[0])
    tracker.update(0, wall)
    for number in range(1, 20):
        pose = MeshFitter(body).neutral(np.array([0.0, 0.0, 2.3]), 0.3 + 0.04 * number, 0.3)
        person = render(body.posed(pose).vertices, model.faces, recording().camera).depth
        found = tracker.update(round(number / 15 * NANOSECONDS), np.where(person > 0.0, person, wall))
        assert found is not None or number < 8
    assert found is not None
    names = [f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist")]
    true = body.posed(pose).placed[[model.index(name) for name in names]]
    assert np.linalg.norm(found.points[ARMS] - true, axis=1).mean() < 0.08


def test_the_person_of_the_body_index_is_tracked(tracker: MeshTracker) -> None:
    image = recording().images[STAMPS[0]]
    index = np.full(image.shape, 255, np.uint8)
    assert tracker.update(STAMPS[0], image, index) is None and tracker.problem == NOBODY
    index[PersonFinder(DepthCamera(recording().camera)).find(image).mask] = 3
    found = tracker.update(STAMPS[1], image, index)
    assert found is not None and np.linalg.norm(off(found), axis=1).mean() < 0.1


def test_an_image_of_another_size_is_refused_and_does_no_harm(tracker: MeshTracker) -> None:
    assert all(tracked(tracker, range(2)))
    with pytest.raises(DepthError, match="100 x 50"):
        tracker.update(STAMPS[2], np.ones((50, 100), np.float32))
    assert all(tracked(tracker, range(3, 5))) and tracker.counters["searches"] == 1


@pytest.fixture
def turning(shared_data: Path) -> tuple[MeshTracker, list[Path]]:
    """A tracker of the mean person, and the depth images of a real person who turns once around."""
    folder = shared_data / "depth_turn"
    if not folder.is_dir():
        pytest.skip(f"the real depth images are absent ({folder})")
    matrix = np.array([[525.0, 0.0, 320.0], [0.0, 525.0, 240.0], [0.0, 0.0, 1.0]])
    body = body_model.load().body()
    view = DepthCamera(Camera("camera", 640, 480, matrix, np.zeros(5)))
    return MeshTracker(view, body, np.eye(len(body.shape))), sorted(folder.glob("*_depth.png"))


def test_a_real_person_who_turns_before_the_camera_is_never_lost(turning: tuple[MeshTracker, list[Path]]) -> None:
    tracker, files = turning
    thorax, ahead = tracker.body.model.index("spine3"), []
    for number, file in enumerate(files):
        # every third image of 30 a second; the wall behind is farther, and nobody gives a mask
        depth = to_metres(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        found = tracker.update(number * NANOSECONDS // 10, depth)
        assert found is not None, (number, tracker.problem)
        ahead.append(found.fit.frames[thorax][[0, 2], 0])
    # once around, in one direction: 355 degrees by the poses of the cameras
    turned = np.degrees(np.unwrap(np.arctan2(*np.transpose(ahead))))
    assert abs(turned[-1] - turned[0]) == pytest.approx(355.0, abs=15.0)


@pytest.mark.slow
def test_the_thorax_of_a_real_person_turns_as_the_camera_around_them(turning: tuple[MeshTracker, list[Path]]) -> None:
    """Without starts with a wide scale the fit stays half a view behind for six views, and this is 6.0 degrees."""
    tracker, files = turning
    thorax, turns = tracker.body.model.index("spine3"), []
    for number, file in enumerate(files):
        depth = to_metres(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        mask = cv2.imread(str(file).replace("depth.png", "mask.jpg"), cv2.IMREAD_GRAYSCALE) > 127
        found = tracker.update(number * NANOSECONDS // 10, depth, np.where(mask, 0, NO_BODY).astype(np.uint8))
        assert found is not None, (number, tracker.problem)
        storage = cv2.FileStorage(str(file).replace("depth.png", "camera.xml"), cv2.FILE_STORAGE_READ)
        turns.append(storage.getNode("R").mat() @ found.fit.frames[thorax])
        storage.release()
    apart = np.array([one.T @ other for one, other in itertools.combinations(turns, 2)])
    assert np.degrees(np.median(np.linalg.norm(so3.rotation_vectors(apart), axis=1))) < 5.75
