"""Rotations in space as the body models need them: quaternions, and their tangent.

Quaternions are (x, y, z, w), as in ROS messages. The tangent is on the right: ``q * exp(v)`` turns first by ``v`` in
the rotated frame. Formulas by Sola, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics" (2018).
scipy's Rotation has one batch dimension, and takes ten times as long for a single rotation.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray

_SMALL = 1e-8
_TINY = 1e-12
_LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, _j, _k], _LEVI_CIVITA[_i, _k, _j] = 1.0, -1.0
SKEW: FloatArray = -_LEVI_CIVITA.reshape(3, 9)
"""(3, 9): ``v @ SKEW`` is the cross product matrix of v, row by row."""
_ONES = np.ones((3, 1))

_MATRIX = np.zeros((16, 9))
# R = (w^2 - u.u) I + 2 u u^T + 2 w [u]x, as a linear map of the products of the quaternion's components
for _i in range(3):
    for _j in range(3):
        _MATRIX[4 * _i + _j, 3 * _i + _j] += 2.0
        _MATRIX[5 * _j, 4 * _i] -= 1.0
    _MATRIX[15, 4 * _i] += 1.0
_MATRIX[3:12:4] += 2.0 * SKEW

# four times the products of a quaternion's components, as a linear map of its rotation matrix and constants
_PRODUCTS: FloatArray = np.zeros((3, 3, 4, 4))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _PRODUCTS[_i, _i] = np.diag([-1.0, -1.0, -1.0, 1.0])
    _PRODUCTS[_i, _i, _i, _i] = 1.0
    _PRODUCTS[_i, _j, [_i, _j], [_j, _i]] = _PRODUCTS[_j, _i, [_i, _j], [_j, _i]] = 1.0
    _PRODUCTS[_k, _j, [_i, 3], [3, _i]] = 1.0
    _PRODUCTS[_j, _k, [_i, 3], [3, _i]] = -1.0
_PRODUCTS = _PRODUCTS.reshape(9, 16)
_UNIT_PRODUCTS: FloatArray = np.eye(4).reshape(16)

_PRODUCT: FloatArray = np.zeros((4, 4, 4))
# a * b = (aw bv + bw av + av x bv, aw bw - av . bv), as the linear map of the products of the quaternions' numbers
for _i in range(3):
    _PRODUCT[3, _i, _i] = _PRODUCT[_i, 3, _i] = 1.0
    _PRODUCT[_i, _i, 3] = -1.0
_PRODUCT[:3, :3, :3] += _LEVI_CIVITA
_PRODUCT[3, 3, 3] = 1.0
_PRODUCT = _PRODUCT.reshape(16, 4)


def wrapped(angles: FloatArray) -> FloatArray:
    """(...) angles wrapped to [-pi, pi), radians."""
    around: FloatArray = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return around


def skew(v: FloatArray) -> FloatArray:
    """(..., 3, 3) the matrices of the cross product with (..., 3) vectors."""
    result: FloatArray = (v @ SKEW).reshape(*v.shape, 3)
    return result


def quat_to_matrix(q: FloatArray) -> FloatArray:
    """(..., 3, 3) rotation matrices of (..., 4) unit quaternions xyzw."""
    products = (q[..., :, None] * q[..., None, :]).reshape(*q.shape[:-1], 16)
    result: FloatArray = (products @ _MATRIX).reshape(*q.shape[:-1], 3, 3)
    return result


def matrix_to_quat(matrix: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions xyzw, w >= 0, of (..., 3, 3) rotation matrices (Shepperd 1978: by the largest part)."""
    # four times the products of the quaternion's components, (n, 4, 4); the largest row is the best conditioned
    outer = (matrix.reshape(-1, 9) @ _PRODUCTS + _UNIT_PRODUCTS).reshape(-1, 4)
    best = outer.reshape(-1, 16)[:, ::5].argmax(axis=1)
    q = outer[4 * np.arange(len(best)) + best]
    # w >= 0
    q /= np.copysign(np.sqrt((q * q).sum(axis=1)), q[:, 3])[:, None]
    result: FloatArray = q.reshape(*matrix.shape[:-2], 4)
    return result


def quat_multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., 4) products of quaternions xyzw: turned by b first."""
    products = a[..., :, None] * b[..., None, :]
    result: FloatArray = products.reshape(*products.shape[:-2], 16) @ _PRODUCT
    return result


def quat_inverse(q: FloatArray) -> FloatArray:
    """(..., 4) inverses of unit quaternions xyzw."""
    inverse: FloatArray = q * np.array([-1.0, -1.0, -1.0, 1.0])
    return inverse


def exp(v: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions xyzw of (..., 3) rotation vectors, radians."""
    # sin(x) / x is 1, exactly, at the least angle
    half = np.maximum(0.5 * np.sqrt((v * v) @ _ONES), _TINY)
    return np.concatenate([(0.5 * np.sin(half) / half) * v, np.cos(half)], axis=-1)


def log(q: FloatArray) -> FloatArray:
    """(..., 3) shortest rotation vectors, radians, of (..., 4) unit quaternions xyzw."""
    vector, scalar = q[..., :3], q[..., 3:]
    norm = np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
    half = np.arctan2(norm, np.abs(scalar))
    scale = np.where(norm > _SMALL, half / np.maximum(norm, _SMALL), 1.0)
    result: FloatArray = 2.0 * np.where(scalar < 0.0, -scale, scale) * vector
    return result


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """(..., 3) shortest rotation vectors, radians, of (..., 3, 3) rotations."""
    return log(matrix_to_quat(rotations))


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """(..., 3, 3) the rotations nearest to (..., 3, 3) matrices (Umeyama 1991)."""
    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    result: FloatArray = left @ right
    return result


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """(3, 3) the mean of (n, 3, 3): the rotation nearest to the sum of all (Moakher 2002, eq. 3.9)."""
    return nearest_rotation(rotations.sum(axis=0))


def right_jacobian(v: FloatArray) -> FloatArray:
    """(..., 3, 3) derivative of ``log(exp(-v) * exp(v + d))`` by d at 0, for rotation vectors (Sola eq. 143)."""
    angle_squared = (v * v).sum(axis=-1)[..., None, None]
    angle = np.sqrt(angle_squared)
    cross = skew(v)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, 2.0 * np.sin(0.5 * safe) ** 2 / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    result: FloatArray = np.eye(3) - first * cross + second * (cross @ cross)
    return result


def right_jacobian_inverse(v: FloatArray) -> FloatArray:
    """(..., 3, 3) derivative of ``log(exp(v) * exp(d))`` by d at 0, for (..., 3) rotation vectors (Sola eq. 144)."""
    angle_squared = (v * v).sum(axis=-1)[..., None, None]
    angle = np.sqrt(angle_squared)
    cross = skew(v)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    # 1/t^2 - (1 + cos t) / (2 t sin t), written with the half angle so that it holds up to pi
    factor = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    result: FloatArray = np.eye(3) + 0.5 * cross + factor * (cross @ cross)
    return result
