"""What the log variables of the table of contents read in the simulated firmware.

Units and signs are the firmware's own: degrees, g, legacy pitch; ``stateEstimateZ`` and
``ctrltargetZ`` in thousandths of the SI units.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from crazyarena.sim_backend.arena_rows import VehicleRows
from crazyarena.sim_backend.crtp.setpoints import compress_quaternion
from crazyarena.sim_backend.firmware import kalman as ka
from crazyarena.sim_backend.firmware import layout as la
from crazyarena.sim_backend.firmware import mellinger, pid
from crazyarena.sim_backend.firmware import supervisor as sv
from crazyarena.sim_backend.physics.arena_plant import AB_VOLTS

Getter = Callable[[], float]

_AXES = ("x", "y", "z")
_MILLI_RADIANS = 1000.0 * math.pi / 180.0
_G = 9810.0  # mm/s2


def _cell(row, index: int, scale: float = 1.0, offset: float = 0.0) -> Getter:
    if scale == 1.0 and offset == 0.0:
        return lambda: row[index]
    return lambda: scale * row[index] + offset


def _bit(guard, bit: int) -> Getter:
    return lambda: int(int(guard[sv.SV_INFO]) & bit != 0)


def getters(rows: VehicleRows) -> dict[str, Getter]:
    """Functions that read the log variables which the simulation models, by full name."""
    table: dict[str, Getter] = {}

    def put(group: str, names: str, row, first: int, scale: float = 1.0) -> None:
        for k, name in enumerate(names.split()):
            table[f"{group}.{name}"] = _cell(row, first + k, scale)

    body, state, setpoint = rows.body, rows.state, rows.setpoint
    put("stateEstimate", "x y z vx vy vz ax ay az roll pitch yaw qx qy qz qw", state, la.ST_POS)
    put("stateEstimateZ", "x y z vx vy vz", state, la.ST_POS, 1000.0)
    put("stateEstimateZ", "ax ay", state, la.ST_ACC, _G)
    table["stateEstimateZ.az"] = _cell(state, la.ST_ACC + 2, _G, _G)
    table["stateEstimateZ.quat"] = lambda: compress_quaternion(
        state[la.ST_QUAT : la.ST_QUAT + 4].tolist()
    )
    for k, name in enumerate(("rateRoll", "ratePitch", "rateYaw")):
        sign = -1.0 if k == 1 else 1.0
        table[f"stateEstimateZ.{name}"] = _cell(state, la.ST_GYRO + k, sign * _MILLI_RADIANS)
    put("gyro", "x y z", state, la.ST_GYRO)
    put("acc", "x y z", state, la.ST_ACCEL)
    put("stabilizer", "roll pitch yaw", state, la.ST_ATT)
    put("sensfusion6", "qx qy qz qw", state, la.ST_QUAT)

    put("ctrltarget", "x y z vx vy vz ax ay az", setpoint, la.SP_POS)
    put("ctrltargetZ", "x y z vx vy vz ax ay az", setpoint, la.SP_POS, 1000.0)
    put("ctrltarget", "roll pitch", setpoint, la.SP_ATT)
    table["ctrltarget.yaw"] = _cell(setpoint, la.SP_RATE + 2)
    table["ctrltarget.thrust"] = _cell(setpoint, la.SP_THRUST)
    put("ctrltarget", "mode_x mode_y mode_z", setpoint, la.SP_MODE)
    put("ctrltarget", "mode_roll mode_pitch mode_yaw mode_quat", setpoint, la.M_ROLL)
    put("posCtl", "targetX targetY targetZ", setpoint, la.SP_POS)

    control, cascade = rows.control, rows.pid
    put("controller", "cmd_roll cmd_pitch cmd_yaw cmd_thrust", control, la.CT_ROLL)
    put("ctrlMel", "cmd_roll cmd_pitch cmd_yaw cmd_thrust", control, la.CT_ROLL)
    table["stabilizer.thrust"] = _cell(control, la.CT_THRUST)
    table["controller.ctr_yaw"] = _cell(control, la.CT_YAW)
    put("controller", "r_roll r_pitch r_yaw", state, la.ST_GYRO)
    put("controller", "roll pitch yaw", cascade, pid.MEM_ATTITUDE)
    put("controller", "rollRate pitchRate yawRate", cascade, pid.MEM_RATE)
    table["controller.accelz"] = _cell(state, la.ST_ACCEL + 2)
    table["controller.actuatorThrust"] = _cell(cascade, pid.MEM_THRUST)
    put("posCtl", "targetVX targetVY targetVZ", cascade, pid.MEM_VEL)
    put("ctrlMel", "i_err_x i_err_y i_err_z", rows.mellinger, mellinger.MEM_I_POS)
    put("ctrlMel", "zdx zdy zdz", rows.mellinger, mellinger.MEM_Z_DESIRED)
    put("motor", "m1 m2 m3 m4", rows.motors, 0)
    put("motor", "m1req m2req m3req m4req", rows.motors, 0)

    filter_ = rows.kalman
    put("kalman", "stateX stateY stateZ statePX statePY statePZ", filter_, ka.KM_S)
    put("kalman", "stateD0 stateD1 stateD2", filter_, ka.KM_S + 6)
    put("kalman", "q0 q1 q2 q3", filter_, ka.KM_Q)
    for k, name in enumerate(("X", "Y", "Z", "PX", "PY", "PZ", "D0", "D1", "D2")):
        table[f"kalman.var{name}"] = _cell(filter_, ka.KM_P + 10 * k)

    guard = rows.supervisor
    table["supervisor.info"] = _cell(guard, sv.SV_INFO)
    table["supervisor.accNorm"] = lambda: math.hypot(*state[la.ST_ACCEL : la.ST_ACCEL + 3])
    table["sys.canfly"] = _bit(guard, sv.INFO_CAN_FLY)
    table["sys.isFlying"] = _bit(guard, sv.INFO_FLYING)
    table["sys.isTumbled"] = _bit(guard, sv.INFO_TUMBLED)

    table["pm.vbat"] = _cell(body, AB_VOLTS)
    table["pm.vbatMV"] = _cell(body, AB_VOLTS, 1000.0)
    return table
