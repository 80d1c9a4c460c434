"""Level files in the competition's layout, put together from its published numbers."""

from __future__ import annotations

TRACK = """\
  gates:
    [  # x, y, z, r, p, y, type
      [0.5, -2.5, 0, 0, 0, -1.57, 0],
      [2, -1.5, 0, 0, 0, 0, 1],
      [0, 0.2, 0, 0, 0, 1.57, 1],
      [-0.5, 1.5, 0, 0, 0, 0, 0]
    ]
  obstacles:
    [  # x, y, z, r, p, y
      [1.5, -2.5, 0, 0, 0, 0],
      [0.5, -1, 0, 0, 0, 0],
      [1.5, 0, 0, 0, 0, 0],
      [-1, 0, 0, 0, 0, 0]
    ]
"""
EMPTY_TRACK = """\
  gates:
    [
    ]
  obstacles:
    [
    ]
"""
CONSTRAINTS = """\
  constraints:
    - constraint_form: default_constraint
      constrained_variable: input
    - constraint_form: bounded_constraint
      constrained_variable: state
      active_dims: [0, 2, 4]
      upper_bounds:
      - 3     # x
      # - 100 # x_dot
      - 3     # y
      - {top}     # z
      lower_bounds:
      - -3
      - -3
      - -0.1
"""
DISTURBANCES = """\
  disturbances:
    action:
      - disturbance_func: white_noise
        std: 0.001
    dynamics:
      - disturbance_func: uniform
        low: [-0.1, -0.1, -0.1]
        high: [0.1, 0.1, 0.1]
"""
DISTURBANCES_AS_DICT = """\
  disturbances:
    action: {disturbance_func: white_noise, std: [0.001, 0.001, 0.001, 0.001]}
    dynamics: {disturbance_func: uniform, low: -0.1, high: 0.1}
"""


def _range(name: str, low: str, high: str) -> str:
    return f'    {name}:\n      distrib: "uniform"\n      low: {low}\n      high: {high}\n'


INIT = "  init_state_randomization_info:\n" + "".join(
    _range(name, "0.0" if name == "init_z" else "-0.1", "0.02" if name == "init_z" else "0.1")
    for name in ("init_x", "init_y", "init_z", "init_phi", "init_theta", "init_psi")
)
# PyYAML reads 1e-6 as text; people write it all the same.
INERTIA = "  inertial_prop_randomization_info:\n" + "".join(
    _range(name, low, high)
    for name, low, high in (
        ("M", "-0.01", "0.01"),
        ("Ixx", "-0.000001", "0.000001"),
        ("Iyy", "-1e-6", "1e-6"),
        ("Izz", "-1.0e-06", "1E-6"),
    )
)


def objects(span: str) -> str:
    return "  gates_and_obstacles_randomization_info:\n" + "".join(
        _range(name, f"-{span}", span) for name in ("gates", "obstacles")
    )


def competition_file(
    *,
    episodes: int = 5,
    gui: bool = False,
    reseed: str | None = "True",
    done: str | None = "True",
    start: bool = False,
    inertia: bool = False,
    span: str | None = None,
    disturbances: str = "",
    track: str = TRACK,
    top: str = "2",
) -> str:
    """Text of a level; ``reseed`` and ``done`` None leave the keys out, as dev-sim2real does."""
    lines = [
        f"num_episodes: {episodes} # Customizable\n",
        "use_firmware: True\nverbose: False\n\nquadrotor_config:\n  seed: 1337\n",
        f"  reseed_on_reset: {reseed}\n" if reseed else "",
        f"  gui: {gui}\n  camera_view: [5, -40, -40, 0.5, -1, 0.5]\n\n",
        "  ctrl_freq: 30\n  pyb_freq: 500\n  episode_len_sec: 33\n\n",
        f"  done_on_violation: {done or False}\n",
        f"  done_on_completion: {done}\n  done_on_collision: True\n" if done else "",
        "  cost: competition\n\n  task: stabilization\n  task_info:\n",
        "    stabilization_goal: [-0.5, 2.9, 0.75]\n    stabilization_goal_tolerance: 0.15\n",
        "  init_state:\n    init_x: -0.9\n    init_x_dot: 0\n    init_y: -2.9\n",
        "    init_y_dot: 0\n    init_z: 0.03\n    init_z_dot: 0\n    init_phi: 0\n",
        "    init_theta: 0\n    init_psi: 0\n    init_p: 0\n    init_q: 0\n    init_r: 0\n\n",
        track,
        f"\n  randomized_init: {start}\n",
        INIT if start else "",
        f"  randomized_inertial_prop: {inertia}\n",
        INERTIA if inertia else "",
        f"  randomized_gates_and_obstacles: {span is not None}\n",
        objects(span) if span else "",
        CONSTRAINTS.format(top=top),
        disturbances,
        "\n  quad_type: 3\n  info_in_reset: True\n",
        "  normalized_rl_action_space: False\n  done_on_out_of_bound: False\n",
    ]
    return "".join(lines)


_RANDOM = {"start": True, "inertia": True, "disturbances": DISTURBANCES}
FILES = {
    "level0": competition_file(),
    "level1": competition_file(**_RANDOM),
    "level2": competition_file(span="0.15", **_RANDOM),
    "level3": competition_file(span="0.15", reseed="False", **_RANDOM),
    "getting_started": competition_file(span="0.1", done="False", episodes=3, gui=True, **_RANDOM),
}
