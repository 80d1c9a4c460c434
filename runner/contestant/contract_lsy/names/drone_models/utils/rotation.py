"""Body rates and the rates of roll, pitch and yaw (fixed axes), for any leading axes.

J. Diebel, "Representing attitude", Stanford 2006, equations for the (1, 2, 3) sequence.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def _angles(quat):
    rpy = Rotation.from_quat(quat).as_euler("xyz")
    return rpy[..., 0], rpy[..., 1]


def ang_vel2rpy_rates(quat, ang_vel):
    """Rates of roll, pitch, yaw for body rates; quaternions x, y, z, w."""
    roll, pitch = _angles(quat)
    p, q, r = np.moveaxis(np.asarray(ang_vel), -1, 0)
    turn = q * np.sin(roll) + r * np.cos(roll)
    tilt = q * np.cos(roll) - r * np.sin(roll)
    return np.stack([p + turn * np.tan(pitch), tilt, turn / np.cos(pitch)], axis=-1)


def rpy_rates2ang_vel(quat, rpy_rates):
    """Body rates for rates of roll, pitch, yaw; quaternions x, y, z, w."""
    roll, pitch = _angles(quat)
    a, b, c = np.moveaxis(np.asarray(rpy_rates), -1, 0)
    flat = c * np.cos(pitch)
    return np.stack(
        [
            a - c * np.sin(pitch),
            b * np.cos(roll) + flat * np.sin(roll),
            flat * np.cos(roll) - b * np.sin(roll),
        ],
        axis=-1,
    )
