"""Quaternions x, y, z, w (body to world) and rotation matrices, for single poses."""

from __future__ import annotations

import math

import numpy as np

from crazyarena.types import Vector

# Cosine of the middle angle below which the outer two turn about the same axis.
_LOCKED = 1e-7


def multiply(a: Vector, b: Vector) -> Vector:
    """Hamilton product: first b, then a."""
    ax, ay, az, aw = a.tolist()
    bx, by, bz, bw = b.tolist()
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def conjugate(quaternion: Vector) -> Vector:
    """Inverse of a unit quaternion."""
    x, y, z, w = quaternion.tolist()
    return np.array([-x, -y, -z, w])


def matrix_of(quaternion: Vector) -> Vector:
    """Rotation matrix (3, 3) of a unit quaternion."""
    x, y, z, w = quaternion.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotate(quaternion: Vector, points: Vector) -> Vector:
    """Rotate ``points`` (n, 3) or (3,) by a unit quaternion."""
    return points @ matrix_of(quaternion).T


def quaternion_of(matrix: Vector) -> Vector:
    """Unit quaternion, w >= 0, of a rotation matrix (3, 3) (Shepperd 1978)."""
    m = matrix
    trace = float(m[0, 0] + m[1, 1] + m[2, 2])
    k = int(np.argmax([float(m[0, 0]), float(m[1, 1]), float(m[2, 2]), trace]))
    q = np.empty(4)
    if k == 3:
        q[:] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q[k] = 1.0 + m[k, k] - m[i, i] - m[j, j]
        q[i] = m[i, k] + m[k, i]
        q[j] = m[j, k] + m[k, j]
        q[3] = m[j, i] - m[i, j]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def angle_between(a: Vector, b: Vector) -> float:
    """Angle of the turn from unit quaternion a to b, rad, 0 to pi."""
    x, y, z, w = multiply(conjugate(a), b).tolist()
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def euler_xyz(quaternion: Vector) -> tuple[float, float, float]:
    """Angles a, b, c in rad with R = Rx(a) Ry(b) Rz(c); a is 0 where only a + c or a - c counts."""
    m = matrix_of(quaternion)
    level = math.hypot(m[1, 2], m[2, 2])
    b = math.atan2(m[0, 2], level)
    if level < _LOCKED:
        return 0.0, b, math.atan2(m[1, 0], m[1, 1])
    return math.atan2(-m[1, 2], m[2, 2]), b, math.atan2(-m[0, 1], m[0, 0])


def kabsch(model: Vector, measured: Vector, weight: Vector) -> tuple[Vector, Vector]:
    """Rotations (b, 3, 3) and translations (b, 3) that carry model points to measured ones.

    model, measured: (b, k, 3); weight: (b, k), 1 for matched points and 0 for others.
    """
    total = weight.sum(axis=1)[:, None]
    model_mean = np.einsum("bk,bkj->bj", weight, model) / total
    measured_mean = np.einsum("bk,bkj->bj", weight, measured) / total
    a = (model - model_mean[:, None]) * weight[:, :, None]
    b = measured - measured_mean[:, None]
    u, _, vt = np.linalg.svd(np.einsum("bki,bkj->bij", a, b))
    sign = np.ones((len(u), 3))
    sign[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = np.einsum("bji,bj,bkj->bik", vt, sign, u)
    return rotation, measured_mean - np.einsum("bij,bj->bi", rotation, model_mean)


def turning(rotation: Vector) -> Vector:
    """Angle of rotation matrices (..., 3, 3), rad."""
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def exponential(vectors: Vector) -> Vector:
    """Rotation matrices (b, 3, 3) of rotation vectors (b, 3) (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)
    safe = np.maximum(angle, 1e-12)
    x, y, z = (vectors / safe[:, None]).T
    zero = np.zeros_like(x)
    k = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    sine = np.sin(angle)[:, None, None]
    versine = (1.0 - np.cos(angle))[:, None, None]
    return np.eye(3) + sine * k + versine * (k @ k)
