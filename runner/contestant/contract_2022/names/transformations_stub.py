"""Rotation matrices as CasADi expressions, under the name competition controllers import."""

import casadi


def csRotXYZ(phi, theta, psi):
    """Return Rz(psi) Ry(theta) Rx(phi) as a 3 x 3 CasADi matrix (angles in rad)."""
    cr, sr = casadi.cos(phi), casadi.sin(phi)
    cp, sp = casadi.cos(theta), casadi.sin(theta)
    cy, sy = casadi.cos(psi), casadi.sin(psi)
    return casadi.blockcat(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
