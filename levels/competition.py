"""Level files of the IROS 2022 Safe Robot Learning Competition, read as they are.

Their layout: ``num_episodes``, ``use_firmware``, ``verbose`` and ``quadrotor_config``, the
latter holding the arguments of safe-control-gym's quadrotor task. What cannot change a flight
(GUI, camera, learning weights) is accepted and dropped; what would change it in a way this
stack does not simulate is refused by name.
"""

from __future__ import annotations

from typing import Any

from crazyarena.levels.document import Node
from crazyarena.levels.values import unknown_key

_TOP = ("num_episodes", "use_firmware", "verbose", "quadrotor_config")

# Competition name -> field of Level, where the value passes through unchanged.
_SAME = {
    "seed": "seed",
    "ctrl_freq": "control_frequency",
    "pyb_freq": "physics_frequency",
    "episode_len_sec": "episode_length",
}
# Their defaults are False where ours are True.
_FLAGS = ("reseed_on_reset", "done_on_collision", "done_on_violation", "done_on_completion")
_STATE = {
    "init_x": "x",
    "init_x_dot": "vx",
    "init_y": "y",
    "init_y_dot": "vy",
    "init_z": "z",
    "init_z_dot": "vz",
    "init_phi": "phi",
    "init_theta": "theta",
    "init_psi": "psi",
    "init_p": "p",
    "init_q": "q",
    "init_r": "r",
}
_INERTIA = {"M": "mass", "Ixx": "ixx", "Iyy": "iyy", "Izz": "izz"}
# Only these values are simulated here.
_FIXED: dict[str, tuple[Any, ...]] = {
    "task": ("stabilization",),
    "cost": ("competition",),
    "quad_type": (3,),
    "physics": ("pyb",),
    "info_in_reset": (True,),
    "normalized_rl_action_space": (False,),
    "done_on_out_of_bound": (False,),
    "use_constraint_penalty": (False,),
    "adversary_disturbance": (None,),
    "prior_prop": (None,),
}
_DROPPED = (
    "gui",
    "camera_view",
    "verbose",
    "output_dir",
    "record",
    "norm_act_scale",
    "obs_goal_horizon",
    "rew_state_weight",
    "rew_act_weight",
    "rew_exponential",
    "info_mse_metric_state_weight",
    "constraint_penalty",
    "adversary_disturbance_offset",
    "adversary_disturbance_scale",
)
_STRUCTURED = (
    "task_info",
    "init_state",
    "inertial_prop",
    "randomized_init",
    "init_state_randomization_info",
    "randomized_inertial_prop",
    "inertial_prop_randomization_info",
    "gates",
    "obstacles",
    "randomized_gates_and_obstacles",
    "gates_and_obstacles_randomization_info",
    "constraints",
    "disturbances",
)
_QUADROTOR = (*_SAME, *_FLAGS, *_STRUCTURED, *_FIXED, *_DROPPED)

# Default tolerance of the original task when a file names none, m.
_DEFAULT_TOLERANCE = 0.05


def is_competition(root: Node) -> bool:
    """Whether a document has the layout of the competition's files."""
    return isinstance(root.value, dict) and "quadrotor_config" in root.value


def owns(key: str) -> bool:
    """Whether an override starting with ``key`` addresses the competition's layout."""
    return key in _TOP


def convert(root: Node) -> Node:
    """Rearrange a competition file into our own layout; nodes keep their origin.

    Raises
    ------
    InputError: unknown or missing fields, wrong shapes, or something not simulated here.
    """
    top = _mapping(root, _TOP)
    config = top["quadrotor_config"]
    fields = _mapping(config, _QUADROTOR)
    for name, allowed in _FIXED.items():
        if name in fields and not _same(fields[name].value, allowed):
            shown = " or ".join("nothing" if value is None else repr(value) for value in allowed)
            fields[name].expected(f"{shown} (nothing else is simulated here)")
    level: dict[str, Node] = {name: top[name] for name in _TOP[:3] if name in top}
    level |= {ours: fields[name] for name, ours in _SAME.items() if name in fields}
    level |= {name: fields.get(name, _at(config, False, name)) for name in _FLAGS}
    level["goal"] = _goal(config, fields)
    level["start"] = _start(config, fields)
    level["track"] = _track(config, fields)
    level["vehicle"] = _vehicle(config, fields)
    level["randomization"] = _randomization(config, fields)
    level["disturbances"] = _disturbances(config, fields)
    level |= _constraints(config, fields)
    return Node(level, root.path, root.source)


def _same(value: Any, allowed: tuple[Any, ...]) -> bool:
    # 3 == 3.0 and 1 == True, so compare the types as well.
    return any(type(value) is type(item) and value == item for item in allowed)


def _at(parent: Node, value: Any, key: str | None = None) -> Node:
    """A value that no one wrote, standing where one would have written it."""
    return Node(value, parent.path if key is None else parent.child(key), parent.source)


def _mapping(node: Node, allowed: tuple[str, ...]) -> dict[str, Node]:
    if not isinstance(node.value, dict):
        node.expected("a mapping of fields")
    for key, member in node.value.items():
        if key not in allowed:
            member.fail(unknown_key(key, list(allowed)))
    return node.value


def _items(node: Node, what: str, count: int | None = None) -> list[Node]:
    if not isinstance(node.value, list) or (count is not None and len(node.value) != count):
        node.expected(what)
    return node.value


def _flag(parent: Node, fields: dict[str, Node], key: str, default: bool | None) -> bool:
    if key not in fields:
        if default is not None:
            return default
        parent.fail("missing; say true or false", key)
    value = fields[key].value
    if not isinstance(value, bool):
        fields[key].expected("true or false")
    return value


def _member(parent: Node, fields: dict[str, Node], key: str, what: str) -> Node:
    if key not in fields:
        parent.fail(f"missing; expected {what}", key)
    return fields[key]


def _optional(fields: dict[str, Node], key: str) -> Node | None:
    node = fields.get(key)
    return None if node is None or node.value is None else node


def _goal(config: Node, fields: dict[str, Node]) -> Node:
    info = _member(config, fields, "task_info", "a mapping with stabilization_goal")
    task = _mapping(info, ("stabilization_goal", "stabilization_goal_tolerance"))
    goal = {
        "position": _member(info, task, "stabilization_goal", "[x, y, z] in m"),
        "tolerance": task.get("stabilization_goal_tolerance", _at(info, _DEFAULT_TOLERANCE)),
    }
    return _at(info, goal)


def _start(config: Node, fields: dict[str, Node]) -> Node:
    given = _optional(fields, "init_state") or _at(config, {}, "init_state")
    if isinstance(given.value, list):
        values = dict(zip(_STATE, _items(given, "12 numbers", 12), strict=True))
    else:
        values = _mapping(given, tuple(_STATE))

    def part(*names: str) -> Node:
        return _at(given, [values.get(name, _at(given, 0.0, name)) for name in names])

    return _at(
        given,
        {
            "position": part("init_x", "init_y", "init_z"),
            "velocity": part("init_x_dot", "init_y_dot", "init_z_dot"),
            "attitude": part("init_phi", "init_theta", "init_psi"),
            "rates": part("init_p", "init_q", "init_r"),
        },
    )


def _track(config: Node, fields: dict[str, Node]) -> Node:
    pose = ("x", "y", "z", "roll", "pitch", "yaw")
    gates, obstacles = [], []
    gates_node = _optional(fields, "gates") or _at(config, [], "gates")
    for row in _items(gates_node, "a list of gates"):
        *numbers, kind = _items(row, "[x, y, z, roll, pitch, yaw, type]", 7)
        if isinstance(kind.value, bool) or kind.value not in (0, 1):
            kind.expected("0 (tall) or 1 (low)")
        gate = dict(zip(pose, numbers, strict=True))
        gate["type"] = Node("low" if kind.value else "tall", kind.path, kind.source)
        gates.append(_at(row, gate))
    obstacles_node = _optional(fields, "obstacles") or _at(config, [], "obstacles")
    for row in _items(obstacles_node, "a list of obstacles"):
        numbers = _items(row, "[x, y, z, roll, pitch, yaw]", 6)
        obstacles.append(_at(row, dict(zip(pose, numbers, strict=True))))
    return _at(
        config, {"gates": _at(gates_node, gates), "obstacles": _at(obstacles_node, obstacles)}
    )


def _vehicle(config: Node, fields: dict[str, Node]) -> Node:
    given = _optional(fields, "inertial_prop") or _at(config, {}, "inertial_prop")
    if isinstance(given.value, list):
        values = dict(zip(_INERTIA, _items(given, "[M, Ixx, Iyy, Izz]", 4), strict=True))
    else:
        values = _mapping(given, tuple(_INERTIA))
    return _at(given, {_INERTIA[name]: node for name, node in values.items()})


def _uniform(node: Node) -> Node:
    """``{distrib: uniform, low, high}`` as ``[low, high]``."""
    values = _mapping(node, ("distrib", "low", "high"))
    kind = _member(node, values, "distrib", "'uniform'")
    if kind.value != "uniform":
        kind.expected("'uniform' (no other distribution is drawn here)")
    bounds = [_member(node, values, name, "a number") for name in ("low", "high")]
    return _at(node, bounds)


def _ranges(
    config: Node, fields: dict[str, Node], key: str, names: dict[str, str], switch: str
) -> Node:
    info = _optional(fields, key)
    if info is None:
        config.fail(f"missing; {switch} is true, so its ranges are needed", key)
    values = _mapping(info, tuple(names))
    return _at(info, {names[name]: _uniform(node) for name, node in values.items()})


def _randomization(config: Node, fields: dict[str, Node]) -> Node:
    result: dict[str, Node] = {}
    # The original randomises the start unless told otherwise, so silence is not taken for "no".
    if _flag(config, fields, "randomized_init", None):
        key = "init_state_randomization_info"
        result["start"] = _ranges(config, fields, key, _STATE, "randomized_init")
    if _flag(config, fields, "randomized_inertial_prop", False):
        key = "inertial_prop_randomization_info"
        result["inertia"] = _ranges(config, fields, key, _INERTIA, "randomized_inertial_prop")
    switch = "randomized_gates_and_obstacles"
    if _flag(config, fields, switch, False):
        key = "gates_and_obstacles_randomization_info"
        names = {"gates": "gates", "obstacles": "obstacles"}
        result["gates_and_obstacles"] = _ranges(config, fields, key, names, switch)
    return _at(config, result)


def _disturbances(config: Node, fields: dict[str, Node]) -> Node:
    given = _optional(fields, "disturbances") or _at(config, {}, "disturbances")
    result = {}
    for mode, node in _mapping(given, ("action", "dynamics")).items():
        specs = node.value if isinstance(node.value, list) else [node]
        if not specs or node.value is None:
            continue
        if len(specs) > 1:
            node.expected("one disturbance (sums of several are not simulated here)")
        kind, names = (
            ("white_noise", ("std",)) if mode == "action" else ("uniform", ("low", "high"))
        )
        values = _mapping(specs[0], ("disturbance_func", *names))
        func = _member(specs[0], values, "disturbance_func", f"'{kind}'")
        if func.value != kind:
            func.expected(f"'{kind}' (the only {mode} disturbance simulated here)")
        result[mode] = _at(
            specs[0], {name: _member(specs[0], values, name, "a number") for name in names}
        )
    return _at(given, result)


def _constraints(config: Node, fields: dict[str, Node]) -> dict[str, Node]:
    given = _optional(fields, "constraints") or _at(config, [], "constraints")
    held = {"input": False, "state": False}
    result: dict[str, Node] = {}
    for node in _items(given, "a list of constraints"):
        allowed = (
            "constraint_form",
            "constrained_variable",
            "active_dims",
            "upper_bounds",
            "lower_bounds",
        )
        values = _mapping(node, allowed)
        variable = _member(node, values, "constrained_variable", "'input' or 'state'")
        if not isinstance(variable.value, str) or variable.value not in held:
            variable.expected("'input' or 'state'")
        if held[variable.value]:
            variable.fail(f"a second constraint on '{variable.value}'; expected at most one")
        held[variable.value] = True
        form = _member(node, values, "constraint_form", "the kind of constraint")
        if variable.value == "input":
            if form.value != "default_constraint":
                form.expected("'default_constraint' (the only one on inputs held here)")
            for name in ("active_dims", "upper_bounds", "lower_bounds"):
                if name in values:
                    values[name].fail("not supported on inputs; the motors set the limits")
            continue
        if form.value != "bounded_constraint":
            form.expected("'bounded_constraint' (the only one on states held here)")
        dims = _member(node, values, "active_dims", "[0, 2, 4] (x, y, z)")
        if dims.plain() != [0, 2, 4]:
            dims.expected("[0, 2, 4] (x, y, z; other states are not constrained here)")
        box = {
            "low": _member(node, values, "lower_bounds", "[x, y, z] in m"),
            "high": _member(node, values, "upper_bounds", "[x, y, z] in m"),
        }
        result["arena"] = _at(node, box)
    result["constraints"] = _at(given, {name: _at(given, flag) for name, flag in held.items()})
    return result
