"""Body-index images: pairing with depth images, choice of the person's body, and their effect on errors."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from depth_recording import recording

from body_tracking.core.message_types import IMAGE
from body_tracking.core.parameters import check_all
from body_tracking.core.qos import LATCHED
from body_tracking.core.skeleton import Joint, SingleArray
from body_tracking.mesh import body_model
from body_tracking.mesh.body_index import NO_BODY, IndexArray, IndexPairs, of_body_index
from body_tracking.mesh.codecs import BodyIndex, DepthImage
from body_tracking.mesh.depth import DepthCamera, DepthError
from body_tracking.mesh.person import COVERED, PersonFinder
from body_tracking.mesh.raster import render
from body_tracking.mesh.solver import MeshFitter
from body_tracking.mesh.stage import MeshStage
from body_tracking.mesh.topics import IMAGES as IMAGES_QOS
from body_tracking.mesh.topics import body_index_topic, depth_topic, info_topic
from body_tracking.messages.base import MessageError
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.codecs import CameraInfo
from body_tracking.messages.images import array_to_image
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagReader, BagWriter
from body_tracking.systems import options_of, played
from draws import some

ARMS = [getattr(Joint, f"{name}_{side}") for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
STAMPS = [*recording().images]
INFO, IMAGES, BODIES = info_topic("kinect1"), depth_topic("kinect1"), body_index_topic("kinect1")
SKELETONS = graph.skeleton_topic("kinect1_mesh")
OWN, OTHER = 2, 4
"""Numbers of the person in the recording, and of somebody else."""
MS = 1_000_000
COUNT = 16
"""Images of a short bag: the filter needs some before it publishes."""


# --- which body


def test_at_the_start_the_largest_body_is_taken_and_then_the_next_ones() -> None:
    index, depth = np.full((4, 60), NO_BODY, np.uint8), np.full((4, 60), 2.0, np.float32)
    index[:, :30], index[:, 40:], index[0, 35] = 2, 5, 1
    mask, body = of_body_index(index, depth)
    assert body == 2 and np.array_equal(mask, index == 2)
    # a few stray pixels are no body
    assert [of_body_index(index, depth, None, choice)[1] for choice in range(4)] == [2, 5, 2, 5]
    depth[:, :20] = 0.0
    mask, body = of_body_index(index, depth)
    assert body == 5 and of_body_index(index, depth, None, 1)[0].sum() == 40
    mask, body = of_body_index(np.full((4, 60), NO_BODY, np.uint8), depth)
    assert body is None and not mask.any()
    with pytest.raises(DepthError, match="60 x 4 for a depth image of 60 x 2"):
        of_body_index(index, depth[:2])


def test_a_tracked_person_is_the_body_near_the_mesh_whatever_its_number() -> None:
    index, depth = np.full((4, 60), NO_BODY, np.uint8), np.full((4, 60), 2.0, np.float32)
    index[:, :30], index[:, 40:] = 2, 5
    near = np.zeros(index.shape, np.bool_)
    near[:, 35:] = True
    assert of_body_index(index, depth, near)[1] == 5
    renumbered = np.where(index == 5, 0, np.where(index == 2, 5, index)).astype(np.uint8)
    assert of_body_index(renumbered, depth, near)[1] == 0
    # somebody else of whom a few pixels come near is not the person
    near[:, :] = False
    near[:, 26:34] = True
    assert of_body_index(index, depth, near)[1] is None


# --- which depth image

DEPTH, INDEX = np.ones((4, 6), np.float32), np.zeros((4, 6), np.uint8)


@pytest.fixture
def counted() -> Counter[str]:
    return Counter()


@pytest.fixture
def pairs(counted: Counter[str]) -> IndexPairs:
    return IndexPairs(BODIES, counted)


def test_without_body_index_images_no_depth_image_waits(pairs: IndexPairs, counted: Counter[str]) -> None:
    for number in range(40):
        pairs.add_depth(33 * MS * number, DEPTH, 0)
        pair = pairs.next(0)
        assert pair is not None and pair.bodies is None and pairs.next(0) is None
    assert not +counted and not pairs.problem and pairs.deadline_ns is None


@pytest.mark.parametrize("first", ["depth", "index"])
def test_images_of_one_stamp_are_paired_in_either_order(pairs: IndexPairs, counted: Counter[str], first: str) -> None:
    found = []
    for number in range(1, 6):
        stamp_ns = 33 * MS * number
        if first == "index":
            pairs.add_index(stamp_ns, INDEX)
        pairs.add_depth(stamp_ns, DEPTH, stamp_ns)
        found.append(pairs.next(stamp_ns))
        if first == "depth":
            pairs.add_index(stamp_ns, INDEX)
            found.append(pairs.next(stamp_ns + 5 * MS))
    given = [pair for pair in found if pair is not None]
    assert [pair.stamp_ns for pair in given] == [33 * MS * number for number in range(1, 6)]
    # before the first body-index image, none is expected
    assert [pair.bodies is not None for pair in given] == [first == "index", True, True, True, True]
    assert counted["images with a body index"] == 4 + (first == "index") and not pairs.problem


def test_a_missing_body_index_image_is_waited_for_no_longer_than_50_ms(
    pairs: IndexPairs, counted: Counter[str]
) -> None:
    pairs.add_index(0, INDEX)
    pairs.add_depth(33 * MS, DEPTH, 40 * MS)
    assert pairs.next(89 * MS) is None and pairs.deadline_ns == 90 * MS
    pair = pairs.next(90 * MS)
    assert pair is not None and pair.bodies is None and counted["images without a body index"] == 1
    # too late
    pairs.add_index(33 * MS, INDEX)
    assert counted["body-index images that came too late"] == 1
    # a lost one: the next body-index image releases the depth image at once
    pairs.add_depth(66 * MS, DEPTH, 100 * MS)
    assert pairs.next(100 * MS) is None
    pairs.add_index(99 * MS, INDEX)
    assert pairs.next(100 * MS) is not None
    # the sensor stops sending body-index images
    pairs.add_depth(2000 * MS, DEPTH, 2000 * MS)
    assert pairs.next(2000 * MS) is not None
    # a jump back of time
    pairs.forget_indices()
    pairs.add_depth(0, DEPTH, 0)
    pairs.forget_depth()
    assert pairs.next(0) is None and pairs.deadline_ns is None


@pytest.mark.parametrize("apart_ms", [-5, 5])
def test_other_stamps_are_counted_named_and_not_waited_for(
    pairs: IndexPairs, counted: Counter[str], apart_ms: int
) -> None:
    waited = []
    for number in range(1, 40):
        stamp_ns = 33 * MS * number
        pairs.add_index(stamp_ns + apart_ms * MS, INDEX)
        pairs.add_depth(stamp_ns, DEPTH, stamp_ns)
        pair = pairs.next(stamp_ns)
        waited.append(pair is None)
        pair = pair or pairs.next(stamp_ns + 50 * MS)
        assert pair is not None and pair.bodies is None
    assert not any(waited[10:]) and counted["body-index images of another stamp"] >= 38
    assert "none has the stamp" in pairs.problem and BODIES in pairs.problem
    pairs.add_index(2000 * MS, INDEX)
    pairs.add_depth(2000 * MS, DEPTH, 0)
    pair = pairs.next(0)
    assert pair is not None and pair.bodies is not None and not pairs.problem


# --- the stage


def two_people(number: int, x: float, distance: float) -> tuple[SingleArray, IndexArray]:
    """An image of the recording in which somebody else, of another shape, stands; and its body-index image.

    Args:
        number: of the image.
        x: metres of the other person to the right of the recorded one.
        distance: of the other person's pelvis; the recorded person's is 2.2 m.
    """
    camera, stamp = recording().camera, STAMPS[number]
    image = recording().images[stamp]
    rng = np.random.default_rng(number)
    # smaller: the larger of two is taken at the start
    shape = np.clip(np.random.default_rng(1).standard_normal(12), -1.0, 1.0)
    shape[0] = -1.0
    body = body_model.load().body(shape)
    standing = MeshFitter(body).neutral(np.array([x, recording().joints[stamp][Joint.SPINE_BASE][1], distance]), 0.1)
    true = render(body.posed(standing).vertices, body.model.faces, camera).depth
    seen = np.round(true + 0.003 * rng.standard_normal(true.shape), 3).astype(np.float32)
    other = (true > 0.0) & ((image == 0.0) | (seen < image))
    index = np.full(image.shape, NO_BODY, np.uint8)
    index[PersonFinder(DepthCamera(camera)).find(image).mask] = OWN
    index[other] = OTHER
    return np.where(other, seen, image), index


def calibrated() -> MeshStage:
    node = MeshStage(check_all(MeshStage.PARAMETERS, {"camera": "kinect1"}), lambda topic: False)
    assert not [*node.take(INFO, recording().camera, Now(0, 0))]
    return node


def error(node: MeshStage, number: int, depth: SingleArray, index: IndexArray | None) -> float:
    """Metres, mean of the recorded person's arms; NaN where no skeleton came."""
    stamp = STAMPS[number]
    outputs = [] if index is None else [*node.take(BODIES, (stamp, "camera", index), Now(0, 0))]
    outputs += node.take(IMAGES, (stamp, "camera", depth), Now(0, 0))
    outputs += node.poll(10**12)
    if not outputs:
        return np.nan
    (skeleton,) = outputs[0].payload
    return float(np.linalg.norm((skeleton.positions - recording().joints[stamp])[ARMS], axis=1).mean())


WALKS = {
    "comes to the person's side until both touch": (np.linspace(1.1, 0.4, 6), 2.3),
    "walks past before the person": (np.linspace(1.2, -1.2, 20), 1.5),
}


@pytest.mark.parametrize("walk", some(list(WALKS)))
def test_the_person_is_kept_while_somebody_else(walk: str) -> None:
    """Errors of the arms' joints with body-index images and without; without, two who touch are one surface."""
    ways, distance = WALKS[walk]
    touching = "touch" in walk
    nodes = {indexed: calibrated() for indexed in ((True, False) if touching else (True,))}
    errors: dict[bool, list[float]] = {indexed: [] for indexed in nodes}
    course = [*ways, *np.full(3, ways[-1])] if touching else [*ways]
    for k, x in enumerate(course):
        depth, index = two_people(3 * k, float(x), distance)
        for indexed, node in nodes.items():
            errors[indexed].append(error(node, 3 * k, depth, index if indexed else None))
    found = np.array(errors[True])
    # an arm that the other person hides is farther off
    assert np.isfinite(found).all() and np.median(found) < 0.05 and found.max() < 0.2
    assert found[-3:].max() < 0.05
    if touching:
        without = np.array(errors[False])[-3:]
        assert np.isnan(without).any() and (np.isnan(without) | (without > 0.15)).all()


def test_bad_body_index_images_are_counted_and_named_and_the_image_is_used_without() -> None:
    node, first = calibrated(), 100
    depth = recording().images[STAMPS[first]]
    index = np.full(depth.shape, NO_BODY, np.uint8)
    assert error(node, first, depth, index[::2, ::2].copy()) < 0.05
    assert node.counters["body-index images of another size"] == 1
    level, text, _ = node.state(0)
    assert level == 1 and f"{BODIES}: 128 x 106 pixels, the depth image has 256 x 212" in text
    message = array_to_image(depth, STAMPS[first + 1], "camera", BAG_MESSAGES, "32FC1")
    with pytest.raises(MessageError, match="32FC1"):
        BodyIndex().decode(BAG_WIRE.serialize(IMAGE, message), BAG_WIRE)
    node.refused(BODIES)
    assert error(node, first + 1, depth, None) < 0.05
    assert node.counters["body-index images of another encoding"] == 1 and "not mono8" in node.state(0)[1]
    # nobody, by one that is right
    assert np.isnan(error(node, first + 2, depth, index)) and node.state(0)[:2] == (0, "")
    assert np.isnan(error(node, first + 3, np.zeros_like(depth), index)) and COVERED in node.state(0)[1]
    # a jump back of time
    node.reset(BODIES)
    node.reset(IMAGES)
    assert error(node, first, depth, None) < 0.05


def test_a_bag_with_body_index_images_is_replayed_with_them(tmp_path: Path) -> None:
    options = options_of(depth=("kinect1",), bag="bag")
    assert played(options, {INFO, IMAGES, BODIES}) == (INFO, IMAGES, BODIES)
    bag_path, out, skeletons = tmp_path / "bag", tmp_path / "out", {}
    with BagWriter(bag_path) as bag:
        bag.add_topic(INFO, CAMERA_INFO, LATCHED)
        for topic in (IMAGES, BODIES):
            bag.add_topic(topic, IMAGE, IMAGES_QOS)
        bag.write(INFO, CameraInfo().encode((STAMPS[0], recording().camera), BAG_WIRE), STAMPS[0])
        for number in range(COUNT):
            stamp, (depth, index) = STAMPS[number], two_people(number, 0.42, 2.3)
            millimetres = np.round(1e3 * depth).astype(np.uint16)
            # no body-index image of the other person; the first depth image did not wait for one
            index[index == OTHER] = NO_BODY
            bag.write(IMAGES, DepthImage().encode((stamp, "camera", millimetres), BAG_WIRE), stamp)
            bag.write(BODIES, BodyIndex().encode((stamp, "camera", index), BAG_WIRE), stamp + MS)
    report = replay(bag_path, out, ReplaySettings((), more={"depth": ("kinect1",)}))
    assert report.counters["kinect1_mesh images with a body index"] == COUNT - 1
    with BagReader(out) as written:
        assert written.topics[BODIES].type_name == IMAGE
        for raw in written.messages([SKELETONS]):
            (skeleton,) = decode_skeletons(raw.cdr) or ()
            skeletons[skeleton.stamp_ns] = skeleton.positions
    # the search in the first image, in which both are one surface, failed; the next one is due 0.2 s later
    assert set(STAMPS[7:COUNT]) <= skeletons.keys()
    for stamp in STAMPS[7:COUNT]:
        assert np.linalg.norm((skeletons[stamp] - recording().joints[stamp])[ARMS], axis=1).mean() < 0.06
