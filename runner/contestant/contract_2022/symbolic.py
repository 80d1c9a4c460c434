"""The quadrotor as CasADi expressions: ``symbolic_model`` and ``symbolic_constraints``.

State x, vx, y, vy, z, vz, phi, theta, psi, p, q, r; input the four rotor forces (N), order
front-left, back-left, back-right, front-right. Rigid-body equations with rotors in X
configuration, no drag.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from crazyarena.errors import DependencyMissing
from crazyarena.levels.contract import GRAVITY, KF, KM
from crazyarena.levels.schema import Level
from crazyarena.runner.judging.referee import FORCE_HIGH, FORCE_LOW

ARM = 0.0397  # m


def _casadi() -> Any:
    try:
        import casadi
    except ImportError as error:
        raise DependencyMissing("casadi", "symbolic", "the symbolic model") from error
    return casadi


def _dynamics(cs: Any, level: Level, x: Any, u: Any) -> Any:
    vehicle = level.vehicle
    phi, theta, psi = x[6], x[7], x[8]
    p, q, r = x[9], x[10], x[11]
    cr, sr = cs.cos(phi), cs.sin(phi)
    cp, sp = cs.cos(theta), cs.sin(theta)
    cy, sy = cs.cos(psi), cs.sin(psi)
    thrust = (u[0] + u[1] + u[2] + u[3]) / vehicle.mass
    lever = ARM / np.sqrt(2.0)
    mx = lever * (u[0] + u[1] - u[2] - u[3])
    my = lever * (-u[0] + u[1] + u[2] - u[3])
    mz = KM / KF * (u[0] - u[1] + u[2] - u[3])
    ixx, iyy, izz = vehicle.ixx, vehicle.iyy, vehicle.izz
    return cs.vertcat(
        x[1],
        (cy * sp * cr + sy * sr) * thrust,
        x[3],
        (sy * sp * cr - cy * sr) * thrust,
        x[5],
        cp * cr * thrust - GRAVITY,
        p + cs.tan(theta) * (sr * q + cr * r),
        cr * q - sr * r,
        (sr * q + cr * r) / cp,
        (mx - (izz - iyy) * q * r) / ixx,
        (my - (ixx - izz) * p * r) / iyy,
        (mz - (iyy - ixx) * p * q) / izz,
    )


def model(level: Level) -> SimpleNamespace:
    """Return the model with the attributes that the competition's had.

    Raises
    ------
    DependencyMissing: CasADi is not installed.
    """
    cs = _casadi()
    nx, nu = 12, 4
    # The step of the environment, which is not the control period.
    dt = 1.0 / level.physics_frequency
    x, u = cs.MX.sym("x", nx), cs.MX.sym("u", nu)
    x_eval, u_eval = cs.MX.sym("x_eval", nx), cs.MX.sym("u_eval", nu)
    x_dot, y = _dynamics(cs, level, x, u), x
    dfdx, dfdu = cs.jacobian(x_dot, x), cs.jacobian(x_dot, u)
    dgdx, dgdu = cs.jacobian(y, x), cs.jacobian(y, u)
    at = cs.Function("at", [x, u], [x_dot, dfdx, dfdu, y, dgdx, dgdu])
    f0, a, b, g0, c, d = at(x_eval, u_eval)
    x_dot_linear = f0 + a @ (x - x_eval) + b @ (u - u_eval)
    y_linear = g0 + c @ (x - x_eval) + d @ (u - u_eval)

    q, r = cs.MX.sym("Q", nx, nx), cs.MX.sym("R", nu, nu)
    xr, ur = cs.MX.sym("Xr", nx), cs.MX.sym("Ur", nu)
    cost = 0.5 * (x - xr).T @ q @ (x - xr) + 0.5 * (u - ur).T @ r @ (u - ur)
    l_x, l_u = cs.jacobian(cost, x), cs.jacobian(cost, u)
    l_xx, l_uu = cs.jacobian(l_x, x), cs.jacobian(l_u, u)
    l_xu = cs.jacobian(l_x, u)
    cost_in = [x, u, xr, ur, q, r]
    cost_names = ["x", "u", "Xr", "Ur", "Q", "R"]
    linear_in = [x, u, x_eval, u_eval]
    linear_names = ["x", "u", "x_eval", "u_eval"]

    def integrator(name: str, rhs: Any, parameters: Any) -> Any:
        problem = {"x": x, "p": parameters, "ode": rhs}
        return cs.integrator(name, "cvodes", problem, 0.0, dt)

    return SimpleNamespace(
        x_sym=x,
        u_sym=u,
        x_dot=x_dot,
        y_sym=y,
        dt=dt,
        nx=nx,
        nu=nu,
        ny=nx,
        integration_algo="cvodes",
        fc_func=cs.Function("fc", [x, u], [x_dot], ["x", "u"], ["f"]),
        fd_func=integrator("fd", x_dot, u),
        g_func=cs.Function("g", [x, u], [y], ["x", "u"], ["g"]),
        dfdx=dfdx,
        dfdu=dfdu,
        dgdx=dgdx,
        dgdu=dgdu,
        df_func=cs.Function("df", [x, u], [dfdx, dfdu], ["x", "u"], ["dfdx", "dfdu"]),
        dg_func=cs.Function("dg", [x, u], [dgdx, dgdu], ["x", "u"], ["dgdx", "dgdu"]),
        x_eval=x_eval,
        u_eval=u_eval,
        x_dot_linear=x_dot_linear,
        y_linear=y_linear,
        fc_linear_func=cs.Function("fc", linear_in, [x_dot_linear], linear_names, ["f_linear"]),
        fd_linear_func=integrator("fd_linear", x_dot_linear, cs.vertcat(x_eval, u_eval, u)),
        g_linear_func=cs.Function("g_linear", linear_in, [y_linear], linear_names, ["g_linear"]),
        cost_func=cost,
        Q=q,
        R=r,
        Xr=xr,
        Ur=ur,
        l_x=l_x,
        l_xx=l_xx,
        l_u=l_u,
        l_uu=l_uu,
        l_xu=l_xu,
        loss=cs.Function(
            "loss",
            cost_in,
            [cost, l_x, l_xx, l_u, l_uu, l_xu],
            cost_names,
            ["l", "l_x", "l_xx", "l_u", "l_uu", "l_xu"],
        ),
    )


class LazyModel:
    """The model, built when its first attribute is read."""

    def __init__(self, level: Level) -> None:
        self._level = level
        self._model: SimpleNamespace | None = None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if self._model is None:
            self._model = model(self._level)
        return getattr(self._model, name)


def constraints(level: Level) -> list[Callable[[Any], Any]]:
    """Return [input g(u), state g(x)], as far as the level has them; g <= 0 is feasible.

    CasADi is needed when they are called.
    """
    result: list[Callable[[Any], Any]] = []
    if level.constraints.input:

        def input_constraint(u: Any) -> Any:
            return _casadi().vertcat(FORCE_LOW - u, u - FORCE_HIGH)

        result.append(input_constraint)
    if level.constraints.state:
        low, high = level.arena.low, level.arena.high

        def state_constraint(x: Any) -> Any:
            cs = _casadi()
            position = cs.vertcat(x[0], x[2], x[4])
            return cs.vertcat(cs.DM(low) - position, position - cs.DM(high))

        result.append(state_constraint)
    return result
