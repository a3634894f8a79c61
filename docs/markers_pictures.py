"""Draw the pictures of docs/markers.md from rendered images: ``python docs/markers_pictures.py``.

``docs/images/markers_images.png``: a board, a wand and targets before the cameras, and what is found of them;
``docs/images/markers_scene.png``: cameras, targets and chain in space, and the angle of the elbow with its 95 % band.
The picture of the viewer is written by ``test/nodes/test_marker_page.py``.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import PIL.Image
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.parameters import check_all
from body_tracking.markers import setup
from body_tracking.markers.boards import Chessboard, Image
from body_tracking.markers.camera_calibration import find_boards
from body_tracking.markers.chain_files import load_chain
from body_tracking.markers.codecs import Balls, CameraImage, PoseOfTarget
from body_tracking.markers.detection import detect
from body_tracking.markers.observations import ImageBalls, TargetPose
from body_tracking.markers.overlay import NO_TARGET, annotate, chain_places, targets_of_balls
from body_tracking.markers.rendering import Sensor, render
from body_tracking.markers.rig_storage import load_rig
from body_tracking.markers.stages import AnglesOfTargetsStage, DetectorStage, TrackerStage, TriangulationStage
from body_tracking.markers.targets_file import load_targets
from body_tracking.markers.wand import Wand
from body_tracking.messages.angles import joint_state_values
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, deserialize
from body_tracking.simulation.marker_bags import COLUMNS, ROWS, SQUARE, TRUE_ANGLES, WAND, board_images, wand_places
from body_tracking.simulation.marker_scene import DIAMETER
from body_tracking.viewing.colours import PALETTE, sensor_colours

ROOT = Path(__file__).resolve().parent.parent
BAG, LAB, IMAGES = ROOT / "bags" / "markers_arm", ROOT / "config" / "marker_setup", ROOT / "docs" / "images"
SIZE = 400, 300
"""Of one panel, pixels."""
STAGES = (DetectorStage, TriangulationStage, TrackerStage, AnglesOfTargetsStage)


def panel(image: Image, title: str) -> Image:
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    cv2.putText(small, title, (12, SIZE[1] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(small, dtype=np.uint8)


def of_board() -> Image:
    """An image of a chessboard with the corners that are found."""
    rig = load_rig(LAB / setup.RIG)
    (images,) = board_images(rig, 1, 3)
    corners = find_boards(Chessboard(COLUMNS, ROWS, SQUARE), [[images[0]]])
    drawn = np.repeat(images[0][:, :, None], 3, axis=2)
    for x, y in corners.pixels:
        cv2.circle(drawn, (round(float(x)), round(float(y))), 6, PALETTE[1], 2, cv2.LINE_AA)
    return panel(drawn, "1  board")


def of_wand() -> Image:
    """An image of a wand, with its balls in their order."""
    rig = load_rig(LAB / setup.RIG)
    balls = wand_places(1, 5)[0]
    image = render(rig.cameras[0], rig.rotations[0], rig.translations[0], balls, DIAMETER, Sensor(), 1).image
    found = detect(image)
    order = Wand(WAND).find(found.pixels)
    assert order is not None
    drawn = annotate(image, found, np.full(len(found.pixels), -1), (), ())
    for number, ball in enumerate(order):
        x, y = found.pixels[ball]
        place = round(float(x)) + 16, round(float(y)) + 8
        cv2.putText(drawn, str(number + 1), place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, NO_TARGET, 2, cv2.LINE_AA)
    return panel(drawn, "2  wand")


class Tracked:
    """What the stages make of the shipped recording."""

    def __init__(self) -> None:
        given = {"setup": str(LAB), "deadline": 1.0, "diameter": DIAMETER}
        stages = [
            stage(check_all(stage.PARAMETERS, {key: value for key, value in given.items() if key in known}))
            for stage in STAGES
            for known in ({item.name for item in stage.PARAMETERS},)
        ]
        self.found: dict[str, list[bytes]] = {}
        runner = OfflineRunner(stages, BAG_WIRE, lambda topic, cdr, at_ns: self.found.setdefault(topic, []).append(cdr))
        with BagReader(BAG) as bag:
            for raw in bag.messages():
                self.found.setdefault(raw.topic, []).append(raw.cdr)
                runner.push(raw.topic, raw.cdr, raw.log_time_ns)
            runner.finish(bag.end_ns)
        self.targets = {target.name: target for target in load_targets(LAB / setup.TARGETS)}
        self.colours = sensor_colours(tuple(self.targets))
        self.every = [
            PoseOfTarget(name).decode(cdr, BAG_WIRE)
            for name in self.targets
            for cdr in self.found[setup.pose_topic(name)]
        ]

    def poses(self, stamp_ns: int) -> list[TargetPose]:
        return [pose for pose in self.every if pose.stamp_ns == stamp_ns]

    def clearest(self) -> ImageBalls:
        """The balls of the left camera at the time at which the targets are furthest apart, and all balls are seen."""
        every = [Balls().decode(cdr, BAG_WIRE) for cdr in self.found[setup.balls_topic("left")]]
        whole = [each for each in every if len(each.pixels) == 15 and len(self.poses(each.stamp_ns)) == 3]

        def spread(balls: ImageBalls) -> float:
            places = np.array([pose.translation[:2] for pose in self.poses(balls.stamp_ns)])
            return float(min(np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)))

        return max(whole, key=spread)

    def angles(self, topic: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """(n,) stamps and (n,) values of each angle, by name."""
        rows = [joint_state_values(deserialize(JOINT_STATE, cdr)) for cdr in self.found[topic]]
        values = np.array([row[2] for row in rows])
        names = [name.removesuffix(f"_{setup.BODY}") for name in rows[0][1]]
        return np.array([row[0] for row in rows]), dict(zip(names, values.T, strict=True))


def of_targets(tracked: Tracked) -> Image:
    """An image of the arm with the targets' names."""
    balls, rig = tracked.clearest(), load_rig(LAB / setup.RIG)
    images = [CameraImage().decode(cdr, BAG_WIRE) for cdr in tracked.found[setup.image_topic("left")]]
    pixels = next(image for stamp_ns, _, image in images if stamp_ns == balls.stamp_ns)
    poses = tracked.poses(balls.stamp_ns)
    names = [pose.name for pose in poses]
    owners = targets_of_balls(rig, 0, balls.pixels, tracked.targets, poses)
    return panel(annotate(pixels, balls, owners, names, [tracked.colours[name] for name in names]), "3  targets")


def draw_scene(axes: plt.Axes, tracked: Tracked) -> None:
    """Cameras, targets and chain, in the frame of the first camera with z up."""

    def upright(points: np.ndarray) -> np.ndarray:
        return points[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0])

    rig, chain = load_rig(LAB / setup.RIG), load_chain(LAB / setup.CHAIN)
    poses = tracked.poses(tracked.clearest().stamp_ns)
    for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True):
        edge = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=float)
        far = (0.2 * camera.rays(edge) - translation) @ rotation
        near = np.tile(-translation @ rotation, (4, 1))
        lines = upright(np.array([*np.stack([near, far], axis=1), *np.stack([far, np.roll(far, 1, axis=0)], axis=1)]))
        axes.add_collection3d(Line3DCollection(lines, colors="0.35", linewidths=1.0))
        below = [*lines[..., :2].mean(axis=(0, 1)), lines[..., 2].min() - 0.06]
        axes.text(*below, setup.camera_name(camera.frame_id), ha="center", va="top")
    for pose in poses:
        balls = upright(tracked.targets[pose.name].points @ pose.rotation.T + pose.translation)
        colour = np.array(tracked.colours[pose.name]) / 255.0
        axes.scatter(*balls.T, color=colour, s=14, depthshade=False)
        axes.text(*(balls.mean(axis=0) + np.array([0.1, 0.0, 0.0])), pose.name, color=colour, va="center")
    centres, lines = chain_places(chain, poses)
    axes.add_collection3d(Line3DCollection(upright(lines), colors="black", linewidths=2.0))
    axes.scatter(*upright(centres).T, color="black", s=30, depthshade=False)
    axes.set(xlim=(-0.25, 0.65), ylim=(-0.1, 1.9), zlim=(-0.35, 0.35))
    axes.set_box_aspect((0.9, 2.0, 0.7), zoom=1.2)
    axes.view_init(elev=18, azim=-60)
    axes.set_axis_off()


def draw_angle(axes: plt.Axes, tracked: Tracked) -> None:
    """The elbow's angle with its 95 % band, and how far it is from the truth."""
    topic = graph.joint_states_topic(setup.BODY)
    stamps, values = tracked.angles(topic)
    _, deviations = tracked.angles(f"{topic}_stddev")
    true_stamps, truth = tracked.angles(TRUE_ANGLES)
    name = "elbow_1"
    seconds = (stamps - true_stamps[0]) / 1e9
    angle, band = np.degrees(values[name]), 1.96 * np.degrees(deviations[name])
    expected = np.degrees(np.interp(stamps, true_stamps, truth[name]))
    upper, lower = axes
    upper.plot((true_stamps - true_stamps[0]) / 1e9, np.degrees(truth[name]), color="0.75", linewidth=4, label="truth")
    upper.plot(seconds, angle, ".", color="tab:blue", markersize=4, label="measured")
    upper.set(ylabel="elbow_1, deg")
    upper.legend(frameon=False, fontsize=8)
    lower.errorbar(seconds, angle - expected, band, fmt=".", markersize=3, linewidth=0.7, color="tab:blue")
    lower.axhline(0.0, color="0.6", linewidth=0.8)
    lower.set(xlabel="s", ylabel="error, deg")
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)


def save(image: PIL.Image.Image, name: str) -> None:
    """As a PNG with a palette, a third of the size; median cut would make the few coloured pixels grey."""
    path = IMAGES / name
    image.convert("RGB").quantize(128, PIL.Image.Quantize.MAXCOVERAGE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    tracked = Tracked()
    save(PIL.Image.fromarray(np.hstack([of_board(), of_wand(), of_targets(tracked)])), "markers_images.png")
    figure = plt.figure(figsize=(10.0, 3.9), dpi=100, layout="constrained")
    left, right = figure.subfigures(1, 2)
    draw_scene(left.add_subplot(projection="3d"), tracked)
    draw_angle(right.subplots(2, 1, sharex=True, height_ratios=(3, 2)), tracked)
    figure.canvas.draw()
    save(PIL.Image.fromarray(np.asarray(figure.canvas.buffer_rgba())), "markers_scene.png")


if __name__ == "__main__":
    main()
