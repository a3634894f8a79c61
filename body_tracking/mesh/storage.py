"""The shape of a person as a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.mesh.body_model import Body, BodyModel

_HEADER: Final = """\
# Shape of a person written by body_tracking: components of the shipped body model in standard deviations of the
# population, and their covariance.
"""


class PersonFileError(BodyTrackingError):
    """Raised for a person's shape file that cannot be read or written."""


def save(path: Path, shape: FloatArray, covariance: FloatArray) -> None:
    """Write a shape (S,) with its covariance (S, S); replaces the file atomically.

    Raises:
        PersonFileError: the file cannot be written.
    """
    content = {"shape": shape.round(6).tolist(), "covariance": covariance.round(8).tolist()}
    files.write_text(path, _HEADER + files.dump_yaml(content, default_flow_style=None), PersonFileError)


def load(path: Path, model: BodyModel) -> tuple[Body, FloatArray]:
    """The body of a person, and the covariance (S, S) of its shape.

    Raises:
        PersonFileError: the file is missing, is not YAML, or holds no valid shape of this model.
    """
    count = model.vertex_shapes.shape[2]
    data = files.read_yaml(path, error=PersonFileError)
    if not isinstance(data, dict) or not {"shape", "covariance"} <= data.keys():
        raise PersonFileError(
            f"{path}: expected the keys shape and covariance, as body_tracking mesh personalise writes"
        )
    try:
        shape, covariance = (np.asarray(data[name], dtype=np.float64) for name in ("shape", "covariance"))
        if covariance.shape != (count, count) or not np.isfinite(covariance).all():
            raise ValueError(
                f"covariance of {covariance.shape}, expected ({count}, {count}) finite numbers; a shape of another "
                "body model has to be estimated anew"
            )
        if np.linalg.eigvalsh(covariance).min() < -1e-6 or not np.allclose(covariance, covariance.T, atol=1e-6):
            raise ValueError("covariance: not symmetric and positive semidefinite")
        return model.body(shape), covariance
    except (TypeError, ValueError) as error:
        raise PersonFileError(f"{path}: {error}") from error
