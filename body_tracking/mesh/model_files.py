"""Reading body model files in SMPL's form: ``.npz``, and ``.pkl`` without executing their content.

A pickle is a program. The official SMPL files are pickles of Python 2 with numpy, scipy and chumpy objects. This reader
has stand-ins for exactly these objects; a stand-in only stores its arguments, and every other name is rejected. It uses
the standard library's unpickler in Python: the one in C allocates as much memory as a file requests.
"""

from __future__ import annotations

import pickle
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
import numpy.typing as npt

from body_tracking.core.errors import BodyTrackingError

MAX_BYTES: Final = 1 << 30
"""Limit of a file, and of an array in it: full SMPL-X takes 600 MB as pickle, and 250 MB at most in one array."""
WANTED: Final = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
EXTRA: Final = ("joint_names", "frames")
"""Arrays of the project's own files: see :mod:`body_tracking.mesh.body_model`."""


class ModelFileError(BodyTrackingError):
    """Raised when a body model file cannot be read or is invalid."""


def read(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a body model file by their names in SMPL's form, as dense arrays.

    Raises:
        ModelFileError: no such file, too large, not an archive or pickle of arrays, malicious, or an array missing.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ModelFileError(f"{path}: {size} bytes, at most {MAX_BYTES} are read")
        found = _read_pickle(path) if path.suffix == ".pkl" else _read_archive(path)
    except OSError as error:
        raise ModelFileError(f"{path}: {error.strerror or error}") from error
    missing = [name for name in WANTED if name not in found and name != "posedirs"]
    if missing:
        raise ModelFileError(f"{path}: no {', '.join(missing)}; is it a body model in SMPL's form?")
    return found


def _read_archive(path: Path) -> dict[str, npt.NDArray[Any]]:
    try:
        with zipfile.ZipFile(path) as archive:
            large = [info.filename for info in archive.infolist() if info.file_size > MAX_BYTES]
        if large:
            raise ModelFileError(f"{path}: {large[0]} unpacks to more than {MAX_BYTES} bytes")
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in (*WANTED, *EXTRA) if name in arrays}
    except (zipfile.BadZipFile, ValueError, EOFError, MemoryError, NotImplementedError, RuntimeError) as error:
        raise ModelFileError(f"{path}: not a readable .npz of arrays: {error}") from error
    except (SyntaxError, TypeError, KeyError, OverflowError, zlib.error) as error:
        raise ModelFileError(f"{path}: broken .npz: {error}") from error


def _read_pickle(path: Path) -> dict[str, npt.NDArray[Any]]:
    with path.open("rb") as file:
        try:
            found = _Reader(file, encoding="latin1").load()
        except ModelFileError as error:
            raise ModelFileError(f"{path}: {error}") from error
        except (pickle.UnpicklingError, ValueError, TypeError, KeyError, IndexError) as error:
            raise ModelFileError(f"{path}: broken pickle: {error}") from error
        except (AttributeError, EOFError, MemoryError, OverflowError, AssertionError, RecursionError) as error:
            raise ModelFileError(f"{path}: broken pickle: {type(error).__name__} {error}") from error
    if not isinstance(found, Mapping):
        raise ModelFileError(f"{path}: holds a {type(found).__name__}, not a dictionary of arrays")
    arrays = {}
    for name in (*WANTED, *EXTRA):
        if name in found:
            try:
                arrays[name] = _as_array(found[name])
            except (ValueError, TypeError, KeyError, IndexError, AttributeError, MemoryError) as error:
                raise ModelFileError(f"{path}: {name} is not an array: {error}") from error
    return arrays


class _StandIn:
    """Stores its arguments and state; ``kind`` names the replaced class."""

    __slots__ = ("arguments", "kind", "state")

    def __init__(self, kind: str, *arguments: object) -> None:
        self.kind, self.arguments, self.state = kind, arguments, cast(Any, None)

    def __setstate__(self, state: object) -> None:
        self.state = state


_NUMPY = ("numpy", "numpy.core.multiarray", "numpy._core.multiarray", "numpy._core.numeric", "numpy.core.numeric")
_KINDS: Final = {
    **{(module, name): name for module in _NUMPY for name in ("_reconstruct", "ndarray", "dtype", "scalar")},
    ("_codecs", "encode"): "encode",
    **{
        (f"scipy.sparse{inner}", f"{kind}_{of}"): kind
        for kind in ("csc", "csr")
        for of in ("matrix", "array")
        for inner in ("", f".{kind}", f"._{kind}")
    },
    ("chumpy.ch", "Ch"): "chumpy",
    ("chumpy.reordering", "Select"): "select",
    ("copy_reg", "_reconstructor"): "rebuilt",
    ("copyreg", "_reconstructor"): "rebuilt",
    ("__builtin__", "object"): "object",
    ("builtins", "object"): "object",
}


class _Name:
    """Replacement of a global name in the pickle; a call returns a stand-in."""

    __slots__ = ("kind",)

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def __call__(self, *arguments: object) -> _StandIn:
        return _StandIn(self.kind, *arguments)


class _Reader(pickle._Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        kind = _KINDS.get((module, name))
        if kind is None:
            raise ModelFileError(f"the pickle asks for {str(module)[:60]}.{str(name)[:60]}, which no body model needs")
        return _Name(kind)

    def persistent_load(self, pid: Any) -> Any:
        raise ModelFileError("the pickle refers to objects outside of it")

    def get_extension(self, code: int) -> None:
        raise ModelFileError("the pickle refers to a registered extension")

    def _new_object(self) -> None:
        """``cls.__new__(cls, *arguments)``, replaced by a stand-in of the class."""
        stack = cast(Any, self).stack
        arguments = stack.pop()
        cls = stack.pop()
        if not isinstance(cls, _Name) or not isinstance(arguments, tuple):
            raise ModelFileError("the pickle makes an object of something that is no class")
        stack.append(cls(*arguments))

    dispatch: ClassVar[dict[int, Any]] = {**pickle._Unpickler.dispatch, pickle.NEWOBJ[0]: _new_object}
    for _refused in (pickle.NEWOBJ_EX, pickle.OBJ, pickle.INST):
        dispatch.pop(_refused[0])


def _raw(value: object) -> bytes:
    """Bytes: text in a pickle of Python 2, a call that encodes text in one of Python 3 with protocol 2."""
    if isinstance(value, _StandIn) and value.kind == "encode":
        value = value.arguments[0]
    return value if isinstance(value, bytes) else cast(str, value).encode("latin1")


def _dtype(value: _StandIn) -> np.dtype[Any]:
    # state: (version, byte order, ...)
    code = _raw(value.arguments[0]).decode("ascii")
    order = value.state[1] if value.state else "="
    order = _raw(order).decode("ascii") if not isinstance(order, str) else order
    if code[:1] not in "fiub" or order not in "<>=|":
        raise ModelFileError(f"an array of {code[:20]!r}; only numbers are read")
    return np.dtype(("" if order == "|" else order) + code)


def _as_array(value: Any, depth: int = 0) -> npt.NDArray[Any]:
    """A dense array from a stand-in's state."""
    if depth > 8:
        raise ModelFileError("arrays within arrays")
    if not isinstance(value, _StandIn):
        array = np.asarray(value)
        if array.dtype.kind not in "fiubU":
            raise ModelFileError(f"an array of {array.dtype}; only numbers are read")
        return array
    if value.kind == "_reconstruct":
        _version, shape, dtype, fortran, raw = value.state
        return _shaped(_raw(raw), shape, _dtype(dtype), bool(fortran))
    if value.kind in ("csc", "csr", "chumpy", "select", "rebuilt"):
        state = value.state
        if value.kind in ("csc", "csr") or "indptr" in state:
            return _dense(state, column=value.kind != "csr", depth=depth)
        if "idxs" in state and "a" in state:  # chumpy's selection of another array's numbers
            chosen: npt.NDArray[Any] = _as_array(state["a"], depth + 1).ravel()[_as_array(state["idxs"], depth + 1)]
            return chosen.reshape([int(n) for n in state["preferred_shape"]])
        return _as_array(state["x"], depth + 1)
    raise ModelFileError(f"a {value.kind} where an array belongs")


def _shaped(raw: bytes, shape: Any, dtype: np.dtype[Any], fortran: bool) -> npt.NDArray[Any]:
    return np.frombuffer(raw, dtype).reshape([int(n) for n in shape], order="F" if fortran else "C")


def _dense(state: Mapping[str, Any], column: bool, depth: int) -> npt.NDArray[Any]:
    rows, columns = (int(n) for n in state["_shape"])
    if rows < 0 or columns < 0 or rows * columns * 8 > MAX_BYTES:
        raise ModelFileError(f"a sparse matrix of {rows} x {columns}")
    data, indices, starts = (_as_array(state[name], depth + 1) for name in ("data", "indices", "indptr"))
    if len(starts) != (columns if column else rows) + 1 or len(data) != len(indices) or np.any(np.diff(starts) < 0):
        raise ModelFileError("a sparse matrix whose parts do not fit each other")
    if starts[0] != 0 or starts[-1] != len(data):
        raise ModelFileError("a sparse matrix whose parts do not fit each other")
    dense = np.zeros((rows, columns))
    other = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    dense[(indices, other) if column else (other, indices)] = data
    return dense
