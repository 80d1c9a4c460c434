"""The identified second-order model: attitude follows its command, thrust acts at once.

With the fitted coefficients a, b, c of each axis: m v' = m g + (k0 + k1 F) R e_z and
angle'' = a angle + b angle' + c command.
"""


def symbolic_dynamics_euler(
    model_rotor_vel=False,
    *,
    mass,
    gravity_vec,
    acc_coef,
    cmd_f_coef,
    rpy_coef,
    rpy_rates_coef,
    cmd_rpy_coef,
    J=None,
    J_inv=None,
):
    """CasADi expressions: derivative, state (position, angles, velocity, their rates), input
    (angles, thrust), output (position, angles)."""
    import casadi as cs

    pos, rpy, vel, rates = (cs.MX.sym(n, 3) for n in ("pos", "rpy", "vel", "drpy"))
    command = cs.MX.sym("cmd_rpyt", 4)
    state = cs.vertcat(pos, rpy, vel, rates)
    cr, cp, cy = cs.cos(rpy[0]), cs.cos(rpy[1]), cs.cos(rpy[2])
    sr, sp, sy = cs.sin(rpy[0]), cs.sin(rpy[1]), cs.sin(rpy[2])
    up = cs.vertcat(cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
    lift = acc_coef + cmd_f_coef * command[3]
    gravity = cs.DM([float(g) for g in gravity_vec])
    coefficients = [cs.DM([float(x) for x in c]) for c in (rpy_coef, rpy_rates_coef, cmd_rpy_coef)]
    turn = coefficients[0] * rpy + coefficients[1] * rates + coefficients[2] * command[:3]
    change = cs.vertcat(vel, rates, up * lift / float(mass) + gravity, turn)
    return change, state, command, cs.vertcat(pos, rpy)
