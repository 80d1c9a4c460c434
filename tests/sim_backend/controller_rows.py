"""Recorded controller inputs as the rows that the kernels read."""

from __future__ import annotations

import numpy as np

from crazyarena.sim_backend.firmware import layout as lay


def generation(data: dict[str, np.ndarray]) -> int:
    """2022 recordings of the controllers are 2 ms apart, those of 2026 1 ms."""
    return 2022 if float(data["dt"]) > 0.0015 else 2026


def state_rows(data: dict[str, np.ndarray]) -> np.ndarray:
    """State rows of shape (sequences, rows, ``STATE_SIZE``)."""
    rows = np.zeros((*data["tick"].shape, lay.STATE_SIZE))
    rows[..., lay.ST_POS : lay.ST_POS + 3] = data["state_pos"]
    rows[..., lay.ST_VEL : lay.ST_VEL + 3] = data["state_vel"]
    rows[..., lay.ST_GYRO : lay.ST_GYRO + 3] = data["gyro_dps"]
    if "state_quat_xyzw" in data:
        rows[..., lay.ST_QUAT : lay.ST_QUAT + 4] = data["state_quat_xyzw"]
        rows[..., lay.ST_ATT + 2] = data["state_yaw_deg"]
    else:
        rows[..., lay.ST_ATT : lay.ST_ATT + 3] = data["state_att_deg"]
    return rows


def setpoint_rows(data: dict[str, np.ndarray]) -> np.ndarray:
    """Setpoint rows of shape (sequences, rows, ``SETPOINT_SIZE``)."""
    rows = np.zeros((*data["tick"].shape, lay.SETPOINT_SIZE))
    rows[..., lay.SP_POS : lay.SP_POS + 3] = data["sp_pos"]
    rows[..., lay.SP_VEL : lay.SP_VEL + 3] = data["sp_vel"]
    if "sp_acc" in data:
        rows[..., lay.SP_ACC : lay.SP_ACC + 3] = data["sp_acc"]
    rows[..., lay.SP_ATT : lay.SP_ATT + 3] = data["sp_att_deg"]
    rows[..., lay.SP_RATE : lay.SP_RATE + 3] = data["sp_rate_dps"]
    rows[..., lay.SP_QUAT : lay.SP_QUAT + 4] = data["sp_quat_xyzw"]
    rows[..., lay.SP_THRUST] = data["sp_thrust"]
    rows[..., lay.SP_MODE : lay.SP_MODE + 7] = data["sp_mode"]
    rows[..., lay.SP_BODY] = data["sp_velocity_body"]
    return rows


def worst(data: dict[str, np.ndarray], error: np.ndarray) -> str:
    """Where the largest error sits, for the message of a failed comparison."""
    flat = error.reshape(*data["tick"].shape, -1).max(axis=-1)
    sequence, row = np.unravel_index(int(np.nanargmax(flat)), flat.shape)
    kind = data["kind_names"][data["kind"][sequence]]
    return f"kind {kind}, sequence {sequence}, row {row}: off by {flat[sequence, row]:g}"
