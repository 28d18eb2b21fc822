"""Small vector and quaternion routines that run on NumPy and on JAX arrays alike.

What depends on no varied field stays a NumPy float64 array from the model to the end of the calculation and
never enters the compiled program. `common` is where the two meet: as soon as one operand is a JAX array, all
of them become JAX arrays of its dtype.

Quaternions are (w, x, y, z) in the last axis, as in MuJoCo.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjMINVAL

Array = Any  # np.ndarray | jax.Array


def varies(array: Array) -> bool:
    """Whether the array depends on a varied field."""
    return isinstance(array, jax.Array)


def common(*arrays: Array) -> tuple[Any, ...]:
    """(module, arrays): NumPy and the arrays themselves, or jax.numpy and the arrays in the one JAX dtype."""
    for array in arrays:
        if varies(array):
            return jnp, *(jnp.asarray(other, array.dtype) for other in arrays)
    return np, *arrays


def module(*arrays: Array) -> ModuleType:
    """The module of `common`."""
    return jnp if any(varies(array) for array in arrays) else np


def override(base: Array, rows: np.ndarray, new: Array) -> Array:
    """`base` with the (static) rows replaced by `new`."""
    if not len(rows):
        return base
    xp, base, new = common(base, new)
    index = np.arange(len(base))
    index[rows] = len(base) + np.arange(len(rows))
    return xp.concatenate([base, new])[index]


def product(a: Array, b: Array) -> Array:
    """Matrix product in one dtype."""
    _, a, b = common(a, b)
    return a @ b


def norm(v: Array) -> Array:
    """Euclidean norm over the last axis, with gradient 0 at the zero vector: (..., n) -> (...)."""
    xp = module(v)
    square = (v * v).sum(-1)
    return xp.where(square > 0, xp.sqrt(xp.where(square > 0, square, xp.ones_like(square))), square)


def direction(v: Array) -> Array:
    """v / |v| over the last axis; (1, 0, 0) where v is zero, as in mju_normalize3."""
    xp = module(v)
    length = norm(v)[..., None]
    zero = length < mjMINVAL
    first = xp.broadcast_to(xp.asarray([1.0, 0.0, 0.0], v.dtype), v.shape)
    return xp.where(zero, first, v / xp.where(zero, xp.ones_like(length), length))


def normalize(quat: Array) -> Array:
    """Unit quaternion, (..., 4)."""
    return quat / norm(quat)[..., None]


def conjugate(quat: Array) -> Array:
    """The opposite rotation, (n, 4)."""
    return quat * np.array([[1, -1, -1, -1]], quat.dtype)


def transpose(matrices: Array) -> Array:
    """Transposed matrices, (n, i, j) -> (n, j, i)."""
    return module(matrices).swapaxes(matrices, 1, 2)


# Products of vectors as one product of matrices: a and b -> all products of their entries -> table. It is a
# fraction of the operations that the formulas written out take, and compiles in a fraction of the time.
_CROSS = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_i, _j, _k], _CROSS[_j, _i, _k] = 1, -1
_HAMILTON = np.zeros((4, 4, 4))  # w = aw bw - av.bv; v = aw bv + bw av + av x bv
_HAMILTON[0, 0, 0] = 1
for _i in range(1, 4):
    _HAMILTON[_i, _i, 0] = -1
    _HAMILTON[0, _i, _i] = _HAMILTON[_i, 0, _i] = 1
_HAMILTON[1:, 1:, 1:] = _CROSS
_ROTATION = np.zeros((4, 4, 3, 3))  # (w^2 - v.v) 1 + 2 v v' + 2 w [v]x
_ROTATION[0, 0] = np.eye(3)
for _i in range(3):
    _ROTATION[_i + 1, _i + 1] -= np.eye(3)
    _ROTATION[0, _i + 1] = 2 * _CROSS[_i].T
    for _j in range(3):
        _ROTATION[_i + 1, _j + 1, _i, _j] += 2


def _bilinear(a: Array, b: Array, table: np.ndarray) -> Array:
    size = table.shape[0] * table.shape[1]
    _, a, b, flat = common(a, b, table.reshape(size, -1))
    products = a[..., :, None] * b[..., None, :]
    return products.reshape(*products.shape[:-2], size) @ flat


def cross(a: Array, b: Array) -> Array:
    """Cross product over the last axis, (..., 3)."""
    return _bilinear(a, b, _CROSS)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions, (..., 4): first b, then a."""
    return _bilinear(a, b, _HAMILTON)


def matrix(quat: Array) -> Array:
    """Rotation matrices of unit quaternions, (n, 4) -> (n, 3, 3)."""
    return _bilinear(quat, quat, _ROTATION).reshape(len(quat), 3, 3)


def rotate(axes: Array, v: Array) -> Array:
    """Turn vectors (n, 3) by rotation matrices (n, 3, 3)."""
    _, axes, v = common(axes, v)
    return (axes * v[:, None, :]).sum(-1)


def rotation_vector(quat: Array) -> Array:
    """Axis times angle in (-pi, pi], (n, 4) -> (n, 3), as mju_quat2Vel for one second."""
    xp = module(quat)
    sine = norm(quat[:, 1:])
    angle = 2 * xp.arctan2(sine, quat[:, 0])
    angle = xp.where(angle > np.pi, angle - 2 * np.pi, angle)
    return direction(quat[:, 1:]) * angle[:, None]
