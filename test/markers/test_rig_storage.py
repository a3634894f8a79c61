"""Rigs in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rigs import rig

from body_tracking.markers.rig_storage import RigFileError, load_rig, save_rig


def test_a_rig_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "made" / "rig.yaml"
    truth = rig(3)
    root = rng.normal(size=(truth.size, truth.size)) * 10.0 ** rng.uniform(-5.0, 0.0, (truth.size, 1))
    root[:5] = 0.0
    truth.covariance[...] = root @ root.T
    save_rig(truth, path)
    loaded = load_rig(path)
    assert [each.frame_id for each in loaded.cameras] == ["a", "b", "c"]
    for mine, theirs in zip(loaded.cameras, truth.cameras, strict=True):
        assert (mine.width, mine.height, mine.model) == (theirs.width, theirs.height, theirs.model)
        np.testing.assert_array_equal(mine.matrix, theirs.matrix)
        np.testing.assert_array_equal(mine.distortion, theirs.distortion)
    np.testing.assert_allclose(loaded.rotations, truth.rotations, atol=1e-14)
    np.testing.assert_array_equal(loaded.translations, truth.translations)
    np.testing.assert_allclose(loaded.covariance, truth.covariance, rtol=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("lens:", "lense:", "lens is missing"),
        ("- 834.0", "- .nan", "lens must be 4 finite numbers"),
        ("- 834.0", "- -834.0", "calibrated"),
        ("covariance:", "covariance:\n- 1.0", "covariance must be"),
        ("model: plumb_bob", "model: fisheye", "plumb_bob"),
        ("frame: b", "frame: a", "frame of its own"),
        ("cameras:", "others:", "cameras is missing"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(rig(), path)
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(RigFileError, match=f"rig.yaml.*{text}"):
        load_rig(path)


def test_no_rig_and_no_file(tmp_path: Path) -> None:
    with pytest.raises(RigFileError, match="cannot be read"):
        load_rig(tmp_path / "absent.yaml")
    for text in ("", "- 1", "cameras: 3", "cameras: [4]", "cameras: []"):
        (tmp_path / "other.yaml").write_text(text)
        with pytest.raises(RigFileError):
            load_rig(tmp_path / "other.yaml")


def test_a_negative_variance_is_refused(tmp_path: Path) -> None:
    truth = rig()
    truth.covariance[0, 0] = -1.0
    save_rig(truth, tmp_path / "rig.yaml")
    with pytest.raises(RigFileError, match="variance is negative"):
        load_rig(tmp_path / "rig.yaml")
