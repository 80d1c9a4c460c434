"""Stands in for ``pybullet`` where it is not installed: drawing does nothing, maths works.

Quaternions are x, y, z, w; Euler angles are roll, pitch, yaw about fixed axes, in radians.
"""

import itertools
import math

GUI, DIRECT = 1, 2
IS_STAND_IN = True


def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)
    return 0 if name.isupper() else _draw


def _draw(*_args, **_kwargs):
    return 0


_numbers = itertools.count()


def _number(*_args, **_kwargs):
    return next(_numbers)


loadURDF = addUserDebugLine = addUserDebugText = _number
removeBody = _draw
connect = disconnect = removeUserDebugItem = removeAllUserDebugItems = _draw


def getQuaternionFromEuler(eulerAngles, physicsClientId=0):
    r, p, y = (0.5 * float(angle) for angle in eulerAngles)
    sr, sp, sy = math.sin(r), math.sin(p), math.sin(y)
    cr, cp, cy = math.cos(r), math.cos(p), math.cos(y)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def getMatrixFromQuaternion(quaternion, physicsClientId=0):
    x, y, z, w = (float(value) for value in quaternion)
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


def getEulerFromQuaternion(quaternion, physicsClientId=0):
    m = getMatrixFromQuaternion(quaternion)
    return (
        math.atan2(m[7], m[8]),
        math.asin(max(-1.0, min(1.0, -m[6]))),
        math.atan2(m[3], m[0]),
    )
