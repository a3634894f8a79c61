"""People in real images: a Kinect's frame with its joints, a video of pedestrians, a portrait without legs.

- kinect: the frame of ``kinect_depth``, in which the 22 joints reported by a Kinect v2 are drawn as unnamed dots;
  distance of each dot to one of our joints, paired one to one, across the line of sight at our depth.
- walkers, with --video, such as ``vtest.avi`` of Debian's package ``opencv-doc``: how long each pedestrian is tracked
  from image to image with one number.
- portrait, with --portrait, such as ``skimage/data/astronaut.png`` of PyPI's ``scikit-image``: joints that are tracked
  where the image ends at the hips; the depth is assumed constant.

--draw FOLDER writes images with the landmarks drawn in.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from body_tracking.camera.lifting import lift
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pictures import drawn_in
from body_tracking.camera.pose_model import ImageArray, Landmarks, PoseModel
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import NANOSECONDS, Joint, TrackingState
from body_tracking.mesh.depth import to_metres

KINECT_FOCAL, KINECT_CENTRE = 365.5, (256.0, 208.0)
"""Nominal intrinsics of the real frame's depth camera, pixels."""
KINECT_BAR_MM = 60.0
WALKER_BAR_S = 10.0
NOBODYS = 0.15
"""Distance in metres beyond which a dot belongs to none of our joints."""
FOLLOWED = 3.0
"""Seconds after which a pedestrian counts as tracked."""
LEGS = [Joint[f"{name}_{side}"] for name in ("KNEE", "ANKLE", "FOOT") for side in ("LEFT", "RIGHT")]
UPPER = [Joint[f"{name}_{side}"] for name in ("SHOULDER", "ELBOW") for side in ("LEFT", "RIGHT")]


def read(path: Path) -> ImageArray:
    """(height, width, 3) red, green, blue."""
    pixels: Any = cv2.imread(str(path))
    if pixels is None:
        raise SystemExit(f"{path}: no image")
    return np.ascontiguousarray(pixels[..., ::-1])


def camera_of(image: ImageArray, focal: float, centre: tuple[float, float] | None = None) -> Camera:
    """A camera without distortion; the default principal point is the centre of the image."""
    height, width = image.shape[:2]
    x, y = centre or ((width - 1) / 2.0, (height - 1) / 2.0)
    matrix = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
    return Camera("camera", width, height, matrix, np.zeros(5))


def person_in(model: PoseModel, image: ImageArray) -> Landmarks:
    """The landmarks of the person in an image, after three updates as in a video."""
    tracker = PersonTracker(model, 1, 0.0)
    people: dict[int, Landmarks] = {}
    for stamp_ns in range(3):
        people = tracker.update(stamp_ns, image)
    return next(iter(people.values()))


def kinect(model: PoseModel, folder: Path) -> tuple[dict[str, float], ImageArray]:
    """Distances to the Kinect's joints, mm, and the image with the landmarks."""
    image = read(folder / "lab_004378_color.png")
    depth = to_metres(cv2.imread(str(folder / "lab_004378_depth.png"), cv2.IMREAD_UNCHANGED))
    dots = ((image[..., 0] < 60) & (image[..., 1] > 190) & (image[..., 2] > 190)).astype(np.uint8)
    _, _, stats, centres = cv2.connectedComponentsWithStats(dots)
    places = centres[1:][stats[1:, cv2.CC_STAT_AREA] >= 2]
    camera = camera_of(image, KINECT_FOCAL, KINECT_CENTRE)
    # remove the dots: they hide the person from the network, and no camera draws any
    clean: ImageArray = cv2.inpaint(image, cv2.dilate(dots, np.ones((3, 3), np.uint8)), 3, cv2.INPAINT_TELEA)
    found = person_in(model, clean)
    lifted = lift(found, depth, camera)
    assert lifted is not None
    ours = lifted.positions[np.isfinite(lifted.positions).all(axis=1)]
    # a dot has no depth: compare it at the depth of the paired joint
    rays = np.column_stack([camera.undistort(places), np.ones(len(places))])
    apart = np.linalg.norm(rays[:, None] * ours[None, :, 2:] - ours[None], axis=2)
    # a dot without a joint of ours (here the Kinect's knees) must not push the others to wrong joints
    rows, columns = linear_sum_assignment(np.minimum(apart, NOBODYS))
    away = 1e3 * apart[rows, columns]
    figures = {
        "joints of the Kinect": len(places),
        "of ours": len(ours),
        "median, mm": float(np.median(away)),
        "largest, mm": float(away.max()),
    }
    return figures, drawn_in(image, [found], image.shape[1])


def walkers(model: PoseModel, path: Path) -> tuple[dict[str, dict[str, float]], ImageArray]:
    """Start and end of each pedestrian's track, s, and an image with most of them."""
    video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS)
    if not video.isOpened() or not rate > 0.0:
        raise SystemExit(f"{path}: no video")
    tracker = PersonTracker(model, 6, 0.3)
    seen: dict[int, list[tuple[float, float, float]]] = {}
    most, picture = 0, np.zeros((1, 1, 3), np.uint8)
    for number in range(sys.maxsize):
        there, pixels = video.read()
        if not there:
            break
        image = np.ascontiguousarray(pixels[..., ::-1])
        people = tracker.update(round(number / rate * NANOSECONDS), image)
        for name, each in people.items():
            seen.setdefault(name, []).append((number / rate, *each.next_region.centre))
        if len(people) >= max(most, 1) and sum(len(seen[name]) > FOLLOWED * rate for name in people) >= most:
            most, picture = len(people), drawn_in(image, people.values(), image.shape[1])
    figures = {
        f"walker {name}": {
            "from, s": places[0][0],
            "to, s": places[-1][0],
            "images": len(places),
            "images between them": round((places[-1][0] - places[0][0]) * rate) + 1,
            "way, pixels": float(np.hypot(places[-1][1] - places[0][1], places[-1][2] - places[0][2])),
        }
        for name, places in seen.items()
        if places[-1][0] - places[0][0] >= FOLLOWED
    }
    return figures, picture


def portrait(model: PoseModel, path: Path) -> tuple[dict[str, Any], ImageArray]:
    """States of the joints, and the image with the landmarks."""
    image = read(path)
    found = person_in(model, image)
    lifted = lift(found, np.ones(image.shape[:2], np.float32), camera_of(image, float(image.shape[1])))
    assert lifted is not None
    names = {state: [joint.name.lower() for joint in Joint if lifted.states[joint] == state] for state in TrackingState}
    figures = {
        "shoulders and elbows tracked": int((lifted.states[UPPER] == TrackingState.TRACKED).sum()),
        "joints of the legs stated": int((lifted.states[LEGS] != TrackingState.NOT_TRACKED).sum()),
        "tracked": ", ".join(names[TrackingState.TRACKED]),
        "inferred": ", ".join(names[TrackingState.INFERRED]) or "none",
    }
    return figures, drawn_in(image, [found], image.shape[1])


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__, data=True)
    parser.add_argument("--video", type=Path, metavar="FILE", help="of pedestrians")
    parser.add_argument("--portrait", type=Path, metavar="FILE", help="an image of an upper body")
    parser.add_argument("--draw", type=Path, metavar="FOLDER", help="write the images with landmarks there")
    args = parser.parse_args()
    model = PoseModel(default_folder())
    figures: dict[str, Any] = {}
    met: dict[str, bool] = {}
    pictures: dict[str, ImageArray] = {}
    if (args.data / "kinect_depth").is_dir():
        figures["kinect"], pictures["kinect"] = kinect(model, args.data / "kinect_depth")
        median = figures["kinect"]["median, mm"]
        met[f"kinect: median {median:.0f} mm, at most {KINECT_BAR_MM:g}"] = median <= KINECT_BAR_MM
    if args.video is not None:
        figures["walkers"], pictures["walkers"] = walkers(model, args.video)
        whole = [
            row["to, s"] - row["from, s"]
            for row in figures["walkers"].values()
            if row["images"] == row["images between them"]
        ]
        longest = max(whole, default=0.0)
        met[f"a walker followed without a break for {longest:.1f} s, at least {WALKER_BAR_S:g}"] = (
            longest >= WALKER_BAR_S
        )
    if args.portrait is not None:
        figures["portrait"], pictures["portrait"] = portrait(model, args.portrait)
        met["portrait: shoulders and elbows, no legs"] = (
            figures["portrait"]["shoulders and elbows tracked"] == len(UPPER)
            and figures["portrait"]["joints of the legs stated"] == 0
        )
    for name, picture in pictures.items():
        if args.draw is not None:
            args.draw.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(args.draw / f"{name}.png"), picture[..., ::-1])
    if not figures:
        print(f"no real images: {args.data} has no kinect_depth, and neither --video nor --portrait is given")
        return common.ABSENT
    common.report(args, figures)
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
