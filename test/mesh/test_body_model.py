"""Body models in SMPL's form: posing, its derivative, the files, and hostile ones."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from decimation import decimate

from body_tracking.core import so3
from body_tracking.mesh import anatomy, body_model
from body_tracking.mesh.body_model import JOINTS, BodyModel, ModelFileError, Pose
from body_tracking.mesh.skinning import lever_arms, vertex_normals
from draws import some
from patience import PATIENCE


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return body_model.load()


@pytest.fixture
def arrays() -> dict[str, Any]:
    with np.load(body_model.SHIPPED[1000]) as archive:
        return dict(archive)


def random_pose(model: BodyModel, rng: np.random.Generator) -> Pose:
    vectors = rng.normal(scale=0.4, size=(len(model.joints), 3))
    return Pose(so3.quat_to_matrix(so3.exp(vectors)), rng.normal(size=3))


@pytest.mark.parametrize("vertices", body_model.SHIPPED)
def test_shipped_model_is_a_closed_surface_of_an_adult_with_its_joints_inside(vertices: int) -> None:
    model = body_model.load(vertices)
    assert model.joint_names == JOINTS
    assert len(model.vertices) == pytest.approx(vertices, rel=0.05)
    assert np.ptp(model.vertices[:, 1]) == pytest.approx(1.69, abs=0.05)
    edges = np.sort(np.concatenate([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert np.all(counts == 2)
    # winding number of a closed surface around a point inside: the solid angles add up to 4 pi
    corners = model.vertices[model.faces]
    for joint in model.joints:
        a, b, c = np.moveaxis(corners - joint, 1, 0)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        top = np.einsum("ij,ij->i", a, np.cross(b, c))
        bottom = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        assert 2.0 * np.arctan2(top, bottom).sum() == pytest.approx(4.0 * np.pi, abs=0.1)


def test_statures_of_the_shape_space_spread_as_the_population_does(model: BodyModel) -> None:
    rng = np.random.default_rng(0)
    statures = [
        np.ptp(model.body(shape).vertices[:, 1]) for shape in rng.normal(size=(200, model.vertex_shapes.shape[2]))
    ]
    # both sexes together: 7 cm within each, their means 13 cm apart
    assert 0.07 < np.std(statures) < 0.115


def test_files_are_small_and_carry_their_licence() -> None:
    assert sum(path.stat().st_size for path in body_model.DATA.iterdir()) < 1_000_000
    assert "CC0" in (body_model.DATA / "LICENSE").read_text()


def test_a_rotation_of_the_first_joint_turns_the_whole_body(model: BodyModel) -> None:
    rng = np.random.default_rng(1)
    body = model.body(rng.normal(size=model.vertex_shapes.shape[2]))
    pose = random_pose(model, rng)
    turn = so3.quat_to_matrix(so3.exp(np.array([0.3, -1.0, 0.5])))
    rotations = pose.rotations.copy()
    rotations[0] = turn @ rotations[0]
    shift = np.array([0.1, 0.2, 0.3])
    moved = body.posed(Pose(rotations, shift))
    root = body.joints[0]
    expected = (body.posed(Pose(pose.rotations, np.zeros(3))).vertices - root) @ turn.T + root + shift
    np.testing.assert_allclose(moved.vertices, expected, atol=1e-12)


def test_bones_keep_their_lengths_and_rest_is_rest(model: BodyModel) -> None:
    body = model.body()
    rest = body.posed(Pose(np.tile(np.eye(3), (len(JOINTS), 1, 1)), np.zeros(3)))
    np.testing.assert_allclose(rest.vertices, model.vertices, atol=1e-12)
    posed = body.posed(random_pose(model, np.random.default_rng(2)))
    lengths = [np.linalg.norm(p[1:] - p[model.parents[1:]], axis=1) for p in (posed.placed, body.joints)]
    np.testing.assert_allclose(*lengths)


def test_lever_arms_are_the_derivative_of_points_on_the_surface(model: BodyModel) -> None:
    rng = np.random.default_rng(3)
    body = model.body(rng.normal(size=model.vertex_shapes.shape[2]))
    pose = random_pose(model, rng)
    corners = model.faces[rng.choice(len(model.faces), 40)]
    shares = rng.dirichlet([1.0, 1.0, 1.0], size=40)

    def points(pose: Pose) -> Any:
        return np.einsum("pc,pca->pa", shares, body.posed(pose).vertices[corners])

    posed = body.posed(pose)
    arms = lever_arms(
        *(corners, shares, posed.rest, model.bones, model.weights, model.parents, body.joints),
        *(posed.turned, posed.placed),
    )
    step = 1e-6
    for joint in range(len(JOINTS)):
        for axis in np.eye(3):
            ends = []
            for sign in (1.0, -1.0):
                rotations = pose.rotations.copy()
                rotations[joint] = rotations[joint] @ so3.quat_to_matrix(so3.exp(sign * step * axis))
                ends.append(points(Pose(rotations, pose.translation)))
            expected = (ends[0] - ends[1]) / (2.0 * step)
            np.testing.assert_allclose(np.cross(posed.turned[joint] @ axis, arms[:, joint]), expected, atol=1e-7)


def test_normals_are_unit_and_point_outwards(model: BodyModel) -> None:
    normals = vertex_normals(model.vertices, model.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    # growing along the normals adds volume
    volumes = [
        np.einsum("fi,fi->", *(lambda c: (c[:, 0], np.cross(c[:, 1], c[:, 2])))(v[model.faces]))
        for v in (model.vertices, model.vertices + 1e-3 * normals)
    ]
    assert volumes[1] > volumes[0] > 0.0


def test_anatomical_frames_are_right_handed_and_point_along_the_bones(model: BodyModel) -> None:
    np.testing.assert_allclose(np.linalg.det(model.frames), 1.0)
    for side in anatomy.SIDES:
        for bone, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
            along = model.joints[model.index(f"{side}_{end}")] - model.joints[model.index(f"{side}_{bone}")]
            down = -model.frames[model.index(f"{side}_{bone}")][:, 2]
            assert along @ down == pytest.approx(np.linalg.norm(along))
        # at rest the elbow is bent forward, not backward: its angle about -y is positive
        relative = model.frames[model.index(f"{side}_shoulder")].T @ model.frames[model.index(f"{side}_elbow")]
        assert relative[0, 2] < 0.0


def test_decimation_keeps_a_closed_surface_near_the_original() -> None:
    steps = np.linspace(0.0, np.pi, 25)[1:-1]
    turns = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    ring = np.array([[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in steps for b in turns])
    sphere = np.concatenate([ring, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    faces = []
    for i in range(len(steps) - 1):
        for j in range(len(turns)):
            a, b = i * len(turns) + j, i * len(turns) + (j + 1) % len(turns)
            faces += [(a, a + len(turns), b), (b, a + len(turns), b + len(turns))]
    last = len(ring) - len(turns)
    for j in range(len(turns)):
        k = (j + 1) % len(turns)
        faces += [(len(ring), j, k), (len(ring) + 1, last + k, last + j)]
    fewer = decimate(sphere, np.array(faces), 200)
    assert len(np.unique(fewer)) == 200
    assert len(fewer) == 2 * 200 - 4  # Euler: closed, without handles
    # a regular mesh of 200 vertices on the unit sphere sags by 2 % in the middle of its faces
    assert np.linalg.norm(sphere[fewer].mean(axis=1), axis=1).min() > 0.9


# --- files of others


def smpl(arrays: dict[str, Any], joints: int) -> dict[str, Any]:
    """A model with the names and sizes of an official file: further joints, pose blend shapes."""
    count = len(arrays["v_template"])
    order = [JOINTS.index(n) if n in JOINTS else 0 for n in body_model.SMPL_JOINTS] + [0] * (joints - 22)
    parents = [2**32 - 1]
    smpl_parents = (0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
    parents += list(smpl_parents) + [20] * (joints - 22)
    weights = np.zeros((count, joints))
    for number, name in enumerate(body_model.SMPL_JOINTS):
        if name in JOINTS:
            weights[:, number] = arrays["weights"][:, JOINTS.index(name)]
    rng = np.random.default_rng(0)
    return {
        "v_template": arrays["v_template"].astype(float),
        "shapedirs": rng.normal(scale=0.01, size=(count, 3, 16)),
        "posedirs": rng.normal(scale=0.001, size=(count, 3, 9 * (joints - 1))),
        "J_regressor": arrays["J_regressor"][order].astype(float),
        "weights": weights,
        "kintree_table": np.array([parents, range(joints)], dtype=np.uint32),
        "f": arrays["f"].astype(np.uint32),
        "bs_type": "lrotmin",
    }


@pytest.mark.parametrize(("joints", "protocol"), some([(24, 2), (52, 4), (55, 2)]))
def test_smpl_files_load_from_npz_and_pickle_alike(
    joints: int, protocol: int, arrays: dict[str, Any], tmp_path: Path
) -> None:
    content = smpl(arrays, joints)
    np.savez(tmp_path / "model.npz", **content)
    content["J_regressor"] = scipy.sparse.csc_matrix(content["J_regressor"])
    content["v_template"] = np.asfortranarray(content["v_template"])
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    ours = body_model.load(tmp_path / "model.pkl")
    theirs = body_model.load(tmp_path / "model.npz")
    assert ours.joint_names[15] == "head" and len(ours.joint_names) == joints
    for name in ("vertices", "joints", "vertex_shapes", "pose_shapes", "weights", "joint_shapes"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    pose = random_pose(ours, np.random.default_rng(1))
    # eq. 3 of Loper et al., with dense weights
    body = ours.body(np.ones(12))
    posed = body.posed(pose)
    dense = np.zeros((len(ours.vertices), joints))
    np.put_along_axis(dense, ours.bones, ours.weights, axis=1)
    rest = body.vertices + ours.pose_shapes @ (pose.rotations[1:] - np.eye(3)).ravel()
    offsets = posed.placed - np.einsum("jab,jb->ja", posed.turned, body.joints)
    expected = np.einsum("nj,jab,nb->na", dense, posed.turned, rest) + dense @ offsets
    np.testing.assert_allclose(posed.vertices, expected, atol=1e-12)


@pytest.mark.parametrize("joints", [20, 24, 52, 55])
def test_clothes_move_the_skin_outwards_but_no_joint_nor_bare_skin(
    joints: int, arrays: dict[str, Any], tmp_path: Path
) -> None:
    path = body_model.SHIPPED[1000]
    if joints > 20:
        path, content = tmp_path / "model.npz", smpl(arrays, joints)
        # the hand's surface moves with a joint behind the wrist
        wrist = body_model.SMPL_JOINTS.index("left_wrist")
        content["weights"][:, [wrist, 22]] = content["weights"][:, [22, wrist]]
        np.savez(path, **content)
    model = body_model.load(path)
    strongest = model.bones[np.arange(len(model.vertices)), model.weights.argmax(axis=1)]
    worn = {}
    for name, component in (("above", -2), ("below", -1)):
        assert not model.joint_shapes[..., component].any()
        moved = np.linalg.norm(model.vertex_shapes[..., component], axis=1)
        worn[name] = {model.joint_names[joint] for joint in np.unique(strongest[moved > 0.0])}
        np.testing.assert_allclose(moved[moved > 0.0], body_model.CLOTHES[1])
        outwards = (model.vertex_shapes[..., component] * vertex_normals(model.vertices, model.faces)).sum(axis=1)
        assert np.median(outwards[moved > 0.0]) > 0.9 * body_model.CLOTHES[1]
    assert {"left_shoulder", "left_elbow", "spine2"} <= worn["above"]
    assert {"pelvis", "left_hip", "right_knee"} <= worn["below"] and not worn["above"] & worn["below"]
    # "joint22" and so on are those of fingers and of the face
    dressed = worn["above"] | worn["below"]
    assert not {"head", "neck", "left_wrist", "right_wrist", "joint22"} & dressed


class ChumpyArray:
    """Pickled like chumpy's arrays: the class's name and a dictionary with the numbers under ``x``."""

    def __init__(self, x: Any) -> None:
        self.x = x


def test_chumpy_arrays_of_the_official_files_load_without_chumpy(arrays: dict[str, Any], tmp_path: Path) -> None:
    content = smpl(arrays, 24)
    content["shapedirs"] = ChumpyArray(content["shapedirs"])
    raw = pickle.dumps(content, protocol=2)
    ours = f"c{__name__}\nChumpyArray\n".encode()
    assert ours in raw
    (tmp_path / "model.pkl").write_bytes(raw.replace(ours, b"cchumpy.ch\nCh\n"))
    assert body_model.load(tmp_path / "model.pkl").vertex_shapes.shape[2] == 12


class Bomb:
    """Runs a command when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


def hostile(name: str, proof: Path) -> bytes:
    if name == "command":
        return pickle.dumps({"v_template": Bomb(proof)})
    if name == "builtin":
        return b"c__builtin__\neval\n(S'open(\"" + str(proof).encode() + b'", "w")\'\ntR.'
    if name == "numpy load":  # a function of an allowed package
        return b"cnumpy\nload\n(S'x'\ntR."
    if name == "attribute of a name":
        return b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__class__\x93."
    if name == "memo of 64 GB":
        return b"N" + pickle.LONG_BINPUT + struct.pack("<I", 2**31) + b"."
    if name == "array of objects":
        return pickle.dumps({"v_template": np.array([{}, None], dtype=object)}, protocol=2)
    if name == "array that is not there":
        array = pickle.dumps({"v_template": np.zeros(1)}, protocol=2)
        return array.replace(b"K\x01\x85", b"J\xff\xff\xff\x7f\x85")
    if name == "sparse of 8 EB":
        matrix = scipy.sparse.csc_matrix(np.zeros((1, 1)))
        matrix._shape = (2**30, 2**30)
        return pickle.dumps({"J_regressor": matrix}, protocol=2)
    if name == "deep":
        return b"(" * 100_000 + b"l" * 100_000 + b"."
    if name == "extension":
        return pickle.EXT1 + b"\x01."
    if name == "persistent":
        return b"Px\n."
    if name == "instance of an instance":
        return b"\x80\x02K\x01)\x81."
    assert name == "cut off"
    return pickle.dumps({"v_template": np.zeros((1000, 3))}, protocol=2)[:5000]


HOSTILE = (
    *("command", "builtin", "numpy load", "attribute of a name", "memo of 64 GB", "array of objects"),
    *("array that is not there", "sparse of 8 EB", "deep", "extension", "persistent", "instance of an instance"),
    "cut off",
)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused_and_run_nothing(name: str, tmp_path: Path) -> None:
    proof = tmp_path / "proof"
    path = tmp_path / "model.pkl"
    path.write_bytes(hostile(name, proof))
    with pytest.raises(ModelFileError, match=r"model\.pkl: "):
        body_model.load(path)
    assert not proof.exists()


@pytest.mark.parametrize("number", range(30))
def test_a_pickle_with_damaged_bytes_is_refused_or_read(number: int, arrays: dict[str, Any], tmp_path: Path) -> None:
    """Never another exception, whatever byte is damaged."""
    small = {name: array[:2] for name, array in smpl(arrays, 24).items() if not isinstance(array, str)}
    rng = np.random.default_rng(number)
    raw = bytearray(pickle.dumps(small, protocol=2))
    for place in rng.integers(0, 400, size=5):
        raw[place] = rng.integers(0, 256)
    path = tmp_path / "model.pkl"
    path.write_bytes(raw)
    with pytest.raises(ModelFileError):  # two vertices alone are no body either
        body_model.load(path)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("v_template", None, "no v_template"),
        ("v_template", np.full((3, 3), np.nan), "v_template"),
        ("weights", np.zeros((4, 20)), "weights"),
        ("f", np.array([[0, 1, 10**6]]), "f: a vertex outside"),
        ("f", np.zeros((1, 3)), "f is"),
        ("kintree_table", np.array([range(20), range(20)]), "each parent"),
        ("J_regressor", np.zeros((20, 5)), "J_regressor"),
        ("joint_names", np.array(["a"] * 20), "joint_names"),
        ("frames", np.zeros((20, 3, 3)), "frames"),
        ("shapedirs", np.array([b"text"]), "shapedirs"),
        ("posedirs", np.zeros((7, 3, 171)), "posedirs"),
    ],
)
def test_arrays_that_are_no_body_are_named(
    name: str, value: Any, says: str, arrays: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "model.npz"
    arrays[name] = value
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(ModelFileError, match=says):
        body_model.load(path)


def test_invalid_or_too_large_archives_are_refused(arrays: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    with pytest.raises(ModelFileError, match="No such file"):
        body_model.load(path)
    path.write_bytes(b"text")
    with pytest.raises(ModelFileError, match="not a readable"):
        body_model.load(path)
    header = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118)
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 3), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("v_template.npy", header + text)
    with pytest.raises(ModelFileError):
        body_model.load(path)
    arrays["v_template"] = np.array([Bomb(tmp_path / "proof")], dtype=object)
    np.savez(path, **arrays)
    with pytest.raises(ModelFileError, match="not a readable"):
        body_model.load(path)
    assert not (tmp_path / "proof").exists()


def test_bad_shapes_are_named(model: BodyModel) -> None:
    for shape in (np.zeros(3), np.full(10, np.nan)):
        with pytest.raises(ValueError, match="finite numbers"):
            model.body(shape)


def test_compiled_code_is_kept(tmp_path: Path) -> None:
    """A second start poses a body without compiling: within 5 s, start of Python included."""
    script = (
        "import numpy as np; from body_tracking.mesh import body_model as b; m = b.load(); "
        "m.body().posed(b.Pose(np.tile(np.eye(3), (20, 1, 1)), np.zeros(3))); "
        "from body_tracking.mesh import skinning as s; print(sum(s.skin.stats.cache_hits.values()))"
    )
    # compiles where nothing has yet
    body_model.load().body().posed(Pose(np.tile(np.eye(3), (20, 1, 1)), np.zeros(3)))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert int(done.stdout) == 1
