"""Draw the pictures of the pages that are computed: each angle of a convention, the T-pose, places of sensors, and the
angles of the shipped recordings beside their truth.

    python docs/pictures.py

Each angle is drawn by the code that computes it: from a pose, the body model is moved so that the angle grows and all
other angles of its convention stay, as far as they can (least squares). The test compares the sign of what is drawn.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import Joint, Skeleton
from body_tracking.evaluation.show import summarise
from body_tracking.kinematics.conventions import angle_names, angles_of
from body_tracking.kinematics.positional import positional_angles
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.recording.replay import ReplaySettings, replay

IMAGES = Path(__file__).resolve().parent / "images"
Array = NDArray[np.float64]
MODEL = UpperBody()
LENGTHS = MODEL.default_lengths()
BLUE, ORANGE, GREY, RED = "#1f77b4", "#ff7f0e", "#b8b8b8", "#c81e1e"
BONES = (
    (Joint.SPINE_BASE, Joint.SPINE_MID), (Joint.SPINE_MID, Joint.SPINE_SHOULDER), (Joint.SPINE_SHOULDER, Joint.NECK),
    (Joint.NECK, Joint.HEAD), (Joint.SPINE_BASE, Joint.HIP_LEFT), (Joint.SPINE_BASE, Joint.HIP_RIGHT),
    (Joint.SPINE_SHOULDER, Joint.SHOULDER_LEFT), (Joint.SHOULDER_LEFT, Joint.ELBOW_LEFT),
    (Joint.ELBOW_LEFT, Joint.WRIST_LEFT), (Joint.WRIST_LEFT, Joint.HAND_LEFT), (Joint.HAND_LEFT, Joint.HAND_TIP_LEFT),
    (Joint.WRIST_LEFT, Joint.THUMB_LEFT), (Joint.SPINE_SHOULDER, Joint.SHOULDER_RIGHT),
    (Joint.SHOULDER_RIGHT, Joint.ELBOW_RIGHT), (Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT),
    (Joint.WRIST_RIGHT, Joint.HAND_RIGHT), (Joint.HAND_RIGHT, Joint.HAND_TIP_RIGHT),
    (Joint.WRIST_RIGHT, Joint.THUMB_RIGHT),
)  # fmt: skip
# name: the directions to the viewer, and to the right and up in the picture; x forward, y to the person's left
VIEWS = {
    "from the front": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "from the left": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "from above": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
}
MOVING = {
    "trunk": ("lumbar",), "shoulder": ("shoulder",), "humeral": ("shoulder",), "elbow": ("elbow",),
    "clavicle": ("clavicle_elevation",), "neck": ("neck",),
}  # fmt: skip
"""Beginning of an angle's name or kind in ``positional`` and ``rep155``: that of the coordinates that move it in the
pictures."""
HAND = ("hand", (Joint.WRIST_LEFT, Joint.HAND_LEFT, Joint.HAND_TIP_LEFT, Joint.THUMB_LEFT))
CLOSER = {
    "wrist": HAND, "forearm": HAND, "elbow_pronation": HAND,
    "neck": ("head", (Joint.SPINE_SHOULDER, Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT, Joint.HEAD)),
    "clavicle": ("shoulders", (Joint.HEAD, Joint.SPINE_MID, Joint.SHOULDER_RIGHT, Joint.ELBOW_LEFT)),
}  # fmt: skip
"""Beginning of the name or kind of angles that are drawn closer: the part of the body, and joints that are in the
picture."""
CONVENTIONS = ("model", "isb", "positional", "rep155", "dh26")
KINDS = {
    "waist": "trunk", "r_head": "neck", "p_head": "neck", "l_y_shoulder": "shoulder_plane",
    "l_p_shoulder": "shoulder", "l_r_shoulder": "shoulder_rotation", "l_elbow": "elbow",
    **{f"theta{number}": "trunk" for number in range(1, 7)}, "theta7": "clavicle", "theta8": "clavicle",
    "theta13": "shoulder", "theta14": "shoulder", "theta15": "shoulder_rotation", "theta17": "elbow",
    "theta18": "wrist", "theta19": "wrist",
}  # fmt: skip
"""What moves, of angles whose names do not say it: those of the trunk and the left side. Without
``y_head``, which moves no point, and theta9 and theta16, which are redundant."""


SHAPE = 0.8
"""Height of an angle's picture over its width."""


def points(q: Array) -> Array:
    """(25, 3) metres; NaN for joints that the model has not."""
    found = np.full((25, 3), np.nan)
    found[MODEL.joints] = MODEL.forward(q, LENGTHS).positions
    return found


def angles(q: Array, convention: str) -> Array:
    """Radians, in the order of ``angle_names``."""
    if convention == "positional":
        states = np.where(np.isfinite(points(q)[:, 0]), 2, 0).astype(np.uint8)
        skeleton = Skeleton(0, "world", points(q), states, covariances=np.tile(1e-8 * np.eye(3), (25, 1, 1)))
        return np.asarray(positional_angles(skeleton).position)
    n = MODEL.nv
    state = ModelEstimate(0, "world", 0, q, np.zeros(n), 1e-8 * np.eye(2 * n), LENGTHS, np.zeros(len(LENGTHS)))
    return np.asarray(angles_of(state, MODEL, convention).position)


def pose(**degrees: float) -> Array:
    """A configuration with these coordinates of the model, all others zero."""
    v = np.zeros(MODEL.nv)
    for name, value in degrees.items():
        v[MODEL.coordinate_names.index(name)] = np.radians(value)
    return np.asarray(MODEL.integrate(MODEL.neutral(), v))


def start(name: str) -> Array:
    """A pose in which the angle is not singular, and shows."""
    name = KINDS.get(name, name)
    out = {"shoulder_x_left": 35.0, "shoulder_x_right": -35.0}
    if "plane" in name:
        return pose(shoulder_x_left=70.0, shoulder_x_right=-35.0)
    if "pronation" in name:  # less, and the thumb begins on the line of the upper arm
        return pose(elbow_flexion_left=90.0, forearm_pronation_left=25.0, **out)
    if "rotation" in name:
        return pose(elbow_flexion_left=90.0, **out)
    if "wrist" in name:
        return pose(elbow_flexion_left=90.0, **out)
    if "elbow" in name:
        return pose(elbow_flexion_left=30.0, **out)
    return pose(**out)


def moved(q: Array, name: str, convention: str, by: float) -> Array:
    """The pose in which the angle is larger by this many radians, and all others of the convention are as they were."""
    names = angle_names(convention)
    # these conventions have fewer angles than the model: what moves is the joint that the name says
    kind = KINDS.get(name, name)
    few = convention in ("positional", "rep155")
    moving = next((words for words in MOVING if few and kind.startswith(words)), None)
    columns = [k for k in range(6, MODEL.nv) if moving is None or MODEL.coordinate_names[k].startswith(MOVING[moving])]
    want = angles(q, convention)
    kept = np.isfinite(want)
    want[names.index(name)] += by
    weights = np.where(np.array(names) == name, 10.0, 1.0)[kept]
    if convention == "model":  # whose angles of the trunk are sums of the spine's two joints
        sums = np.array([n.startswith("trunk") for n in names])[kept]
        parts = np.array([n.startswith(("lumbar", "thoracic")) for n in names])[kept]
        weights[parts if name.startswith("trunk") else sums] = 0.0
    for _ in range(15):
        error = (want - angles(q, convention))[kept]
        error = (error + np.pi) % (2 * np.pi) - np.pi
        jacobian = np.zeros((kept.sum(), MODEL.nv))
        for k in columns:
            v = np.zeros(MODEL.nv)
            v[k] = 1e-5
            ends = [angles(MODEL.integrate(q, sign * v), convention)[kept] for sign in (-1.0, 1.0)]
            jacobian[:, k] = ((ends[1] - ends[0] + np.pi) % (2 * np.pi) - np.pi) / 2e-5
        a, b = weights[:, None] * jacobian, weights * error
        step = np.linalg.solve(a.T @ a + 1e-4 * np.eye(MODEL.nv), a.T @ b)
        q = np.asarray(MODEL.integrate(q, step * min(1.0, 0.2 / max(np.abs(step).max(), 1e-9))))
        if np.abs(b).max() < 2e-3:
            break
    return q


def draw(axes: Axes, at: Array, view: str, colour: str | None, width: float) -> None:
    """The bones of a body, the nearest last; without a colour the left side is blue, the right one orange."""
    viewer, right, up = (np.array(axis) for axis in VIEWS[view])
    flat, near = np.stack([at @ right, at @ up], axis=-1), at @ viewer
    for one, two in sorted(BONES, key=lambda bone: float(near[list(bone)].sum())):
        side = BLUE if "LEFT" in two.name else ORANGE if "RIGHT" in two.name else "#333333"
        axes.plot(*flat[[one, two]].T, color=colour or side, linewidth=width, solid_capstyle="round", zorder=2)
    if view != "from above":
        axes.plot(*flat[Joint.HEAD], "o", color=colour or "#333333", markersize=7 * width / 2.0, zorder=2)


def panel(axes: Axes, name: str, convention: str) -> None:
    """One angle: the pose before in grey, the pose with a larger angle in colour, and how the farthest point moves."""
    before = start(name)
    kind = KINDS.get(name, name)
    small = any(word in kind for word in ("clavicle", "wrist", "neck", "lumbar", "thoracic", "thorax", "trunk"))
    by = np.radians(22.0 if small else 35.0)
    path = [before]
    for _ in range(3):
        path.append(moved(path[-1], name, convention, by / 3))
    track = np.stack([points(q) for q in path])
    closer = next((words for words in CLOSER if kind.startswith(words)), None)
    part, joints = CLOSER[closer] if closer else ("", tuple(MODEL.joints))
    travel = np.linalg.norm(track[-1] - track[0], axis=1)
    farthest = max(joints, key=lambda joint: float(travel[joint]))
    along = track[-1, farthest] - track[0, farthest]
    choice = [v for v in VIEWS if v != "from the front" or not kind.startswith("wrist")]
    view = min(choice, key=lambda v: (abs(float(along @ np.array(VIEWS[v][0]))), v))
    draw(axes, track[0], view, GREY, 2.5)
    draw(axes, track[-1], view, None, 2.0)
    _, right, up = (np.array(axis) for axis in VIEWS[view])
    flat = np.stack([track[:, farthest] @ right, track[:, farthest] @ up], axis=-1)
    axes.plot(*flat[:-1].T, color=RED, linewidth=1.6, zorder=4)
    axes.annotate("", flat[-1], flat[-2], arrowprops={"arrowstyle": "-|>", "color": RED, "lw": 1.6}, zorder=5)
    own = name if name.startswith("thorax") else name.removesuffix("_left")  # of the trunk it is a direction
    axes.set_title(own.replace("_", " "), fontsize=9, fontweight="bold", pad=3)
    seen = np.concatenate([track[0][list(joints)], track[-1][list(joints)]]) @ np.stack([right, up], axis=1)
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    half = float((1.3 * (0.5 * np.ptp(seen, axis=0) + 0.03) * (1.0, 1.0 / SHAPE)).max())
    if part == "hand":
        for place, word in ((Joint.THUMB_LEFT, "thumb"), (Joint.HAND_TIP_LEFT, "fingers")):
            end, wrist = (track[-1, joint] @ np.stack([right, up], axis=1) for joint in (place, Joint.WRIST_LEFT))
            if np.linalg.norm(end - wrist) > 0.03:
                axes.text(*(wrist + 1.3 * (end - wrist)), word, fontsize=7, ha="center", va="center", color=BLUE)
    view = f"{view}: {part}" if part else view
    axes.text(0.5, -0.04, view, transform=axes.transAxes, ha="center", va="top", fontsize=8, color="#666666")
    axes.set_aspect("equal")
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - SHAPE * half, middle[1] + SHAPE * half)
    axes.axis("on")
    axes.set_xticks([])
    axes.set_yticks([])
    for edge in axes.spines.values():
        edge.set_color("#dddddd")


def drawn(convention: str) -> list[str]:
    """The angles that are drawn: those of the trunk, and the left ones."""
    if convention in ("rep155", "dh26"):
        return [name for name in angle_names(convention) if name in KINDS]
    return [name for name in angle_names(convention) if not name.endswith("_right") or name.endswith("lateral_right")]


def picture(convention: str) -> None:
    """All angles of a convention."""
    names = drawn(convention)
    columns = 5
    rows = -(-len(names) // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(10.0, 2.0 * rows), squeeze=False)
    for axes in grid.flat:
        axes.axis("off")
    for axes, name in zip(grid.flat, names, strict=False):
        panel(axes, name, convention)
    figure.tight_layout(pad=0.6)
    save(figure, f"angles_{convention}")


def save(figure: plt.Figure, name: str) -> None:
    """As a PNG file of 64 colours, which are enough for lines."""
    path = IMAGES / f"{name}.png"
    figure.savefig(path, dpi=100, facecolor="white")
    plt.close(figure)
    reduce_colours(path, 64)


def reduce_colours(path: Path, count: int) -> None:
    """A picture of lines with fewer colours, in a quarter of the bytes."""
    with Image.open(path) as image:
        image.convert("RGB").quantize(count, dither=Image.Dither.NONE).save(path, optimize=True)


def t_pose() -> None:
    """The pose that calibration asks for."""
    q = pose(shoulder_x_left=90.0, shoulder_x_right=-90.0)
    at = points(q)
    for side in (1.0, -1.0):  # the model ends at the hips
        hip, x = (Joint.HIP_LEFT if side > 0 else Joint.HIP_RIGHT), side * 0.1
        leg = np.array([[0.0, x, -0.43], [0.0, x, -0.85], [0.12, x, -0.88]])
        at[[hip + 1, hip + 2, hip + 3]] = leg
    legs = [(h + k, h + k + 1) for h in (Joint.HIP_LEFT, Joint.HIP_RIGHT) for k in range(3)]
    figure, grid = plt.subplots(1, 2, figsize=(8.0, 4.0))
    for axes, view in zip(grid, ("from the front", "from above"), strict=True):
        draw(axes, at, view, None, 4.0)
        _, right, up = (np.array(axis) for axis in VIEWS[view])
        for one, two in legs if view == "from the front" else []:
            side = BLUE if one < Joint.HIP_RIGHT else ORANGE
            axes.plot([at[one] @ right, at[two] @ right], [at[one] @ up, at[two] @ up], color=side, linewidth=4.0)
        axes.set_title(view, fontsize=10)
        axes.set_aspect("equal")
        axes.set_xlim(-1.0, 1.0)
        axes.axis("off")
    grid[0].annotate("arms level and straight", (0.5, 0.51), (0.2, 0.75), fontsize=9, arrowprops={"arrowstyle": "->"})
    grid[0].annotate("palms down", (-0.72, 0.5), (-0.95, 0.15), fontsize=9, arrowprops={"arrowstyle": "->"})
    grid[0].annotate("feet under\nthe hips", (0.12, -0.85), (0.35, -0.7), fontsize=9, arrowprops={"arrowstyle": "->"})
    grid[1].annotate("arms in line with the shoulders", (0.6, 0.0), (-0.1, 0.28), fontsize=9,
                     arrowprops={"arrowstyle": "->"})  # fmt: skip
    grid[1].annotate("", (0.0, -0.4), (0.0, -0.1), arrowprops={"arrowstyle": "->"})
    grid[1].text(0.04, -0.36, "looks forward", fontsize=9)
    grid[1].set_ylim(-0.6, 0.5)
    figure.tight_layout()
    save(figure, "t_pose")


def places(name: str, least: float, greatest: float, what: str, side: bool) -> None:
    """Two sensors at 2 m, from above and, if asked for, from the side; degrees from the person's front."""
    figure, grid = plt.subplots(1, 2 if side else 1, figsize=(9.0 if side else 5.0, 3.8), squeeze=False)
    axes = grid[0, 0]
    axes.plot([-0.22, 0.22], [0.0, 0.0], color="#333333", linewidth=6, solid_capstyle="round")
    axes.plot(0.0, -0.03, "o", color="#333333", markersize=9)
    axes.annotate("", (0.0, -0.55), (0.0, -0.12), arrowprops={"arrowstyle": "->"})
    axes.text(0.0, -1.0, "the person\nlooks here", fontsize=9, ha="center")
    for sign, colour in ((1.0, BLUE), (-1.0, ORANGE)):
        middle = np.radians(sign * 0.5 * (least + greatest))
        for angle in np.radians([sign * least, sign * greatest]):
            axes.plot([0.0, 2.0 * np.sin(angle)], [0.0, -2.0 * np.cos(angle)], color=GREY, linewidth=1, linestyle=":")
        at = np.array([2.0 * np.sin(middle), -2.0 * np.cos(middle)])
        axes.plot([0.15 * at[0], at[0]], [0.15 * at[1], at[1]], color=colour, linewidth=1)
        axes.plot(*at, "s", color=colour, markersize=14)
        axes.text(*(at + [0.0, -0.3]), f"{what}{1 if sign > 0 else 2}", ha="center", fontsize=9)
    axes.text(1.35, -0.75, f"{least:g} to {greatest:g}° from\nthe front, 2 m away", fontsize=9)
    axes.set_title("from above", fontsize=10)
    axes.set_xlim(-2.2, 3.1)
    axes.set_ylim(-2.4, 0.4)
    if side:
        axes = grid[0, 1]
        axes.plot([0.0, 0.0], [0.0, 1.5], color="#333333", linewidth=5, solid_capstyle="round")
        axes.plot(0.0, 1.65, "o", color="#333333", markersize=13)
        axes.plot([2.0, 2.0], [0.0, 0.95], color=GREY, linewidth=3)
        axes.plot(2.0, 1.0, "s", color=BLUE, markersize=13)
        axes.plot([-0.5, 2.5], [0.0, 0.0], color="#666666", linewidth=1)
        for height in (0.0, 2.2):
            axes.plot([2.0, 0.0], [1.0, height], color=BLUE, linewidth=0.8, linestyle=":")
        axes.annotate("", (0.0, 0.2), (2.0, 0.2), arrowprops={"arrowstyle": "<->"})
        axes.text(0.9, 0.24, "2 m", fontsize=9)
        axes.annotate("", (2.25, 0.0), (2.25, 1.0), arrowprops={"arrowstyle": "<->"})
        axes.text(2.32, 0.45, "1 m", fontsize=9)
        axes.text(0.75, 2.0, "feet and raised hands are in view", fontsize=9)
        axes.set_title("from the side", fontsize=10)
        axes.set_xlim(-0.5, 3.2)
        axes.set_ylim(-0.1, 2.4)
    for axes in grid.flat:
        axes.set_aspect("equal")
        axes.axis("off")
    figure.tight_layout()
    save(figure, name)


def shipped(bag: str) -> None:
    """Every angle of a shipped recording beside its truth, as ``replay --filter ekf --convention isb`` and ``show``."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / bag
        settings = ReplaySettings((), filter_name="ekf", convention="isb")
        replay(IMAGES.parent.parent / "bags" / bag, out, settings)
        summarise(out, IMAGES / f"{bag}.png")
    reduce_colours(IMAGES / f"{bag}.png", 128)


PICTURES: dict[str, Callable[[], None]] = {
    **{f"angles_{c}": lambda c=c: picture(c) for c in CONVENTIONS},  # type: ignore[misc]
    "t_pose": t_pose,
    **{bag: lambda bag=bag: shipped(bag) for bag in ("tpose_wave", "tpose_slow_down", "tpose_torso_twist")},  # type: ignore[misc]
    "place_kinects": lambda: places("place_kinects", 30.0, 45.0, "kinect", side=True),
    "place_webcams": lambda: places("place_webcams", 30.0, 45.0, "camera", side=False),
}


if __name__ == "__main__":
    for make in PICTURES.values():
        make()
