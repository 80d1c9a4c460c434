"""Layout of the rows that the firmware kernels share.

A row is a float64 vector of one vehicle. Units are the firmware's own, because the recorded
truth and the controllers' gains are: degrees, degrees per second, g, and the *legacy* pitch
sign (nose up positive, the negative of the usual ZYX pitch) where the name says so.
"""

from __future__ import annotations

# Estimated state and filtered sensors.
ST_POS = 0  # m, world
ST_VEL = 3  # m/s, world
ST_ACC = 6  # g, world, gravity removed
ST_ATT = 9  # deg: roll, pitch (legacy sign), yaw
ST_QUAT = 12  # x, y, z, w, body to world
ST_GYRO = 16  # deg/s, body axes, no sign change
ST_ACCEL = 19  # g, body axes, specific force
STATE_SIZE = 22

# Setpoint.
SP_POS = 0  # m
SP_VEL = 3  # m/s, world (or body, see SP_BODY)
SP_ACC = 6  # m/s2
SP_JERK = 9  # m/s3
SP_ATT = 12  # deg: roll, pitch (legacy sign), yaw
SP_RATE = 15  # deg/s: roll, pitch, yaw
SP_QUAT = 18  # x, y, z, w
SP_THRUST = 22  # 0..65535
SP_MODE = 23  # seven of MODE_*: x, y, z, roll, pitch, yaw, quat
SP_BODY = 30  # 1.0 when the velocity is in the yaw-aligned body frame
SP_TIME = 31  # ms, when the setpoint was accepted
SETPOINT_SIZE = 32

M_X, M_Y, M_Z, M_ROLL, M_PITCH, M_YAW, M_QUAT = range(SP_MODE, SP_MODE + 7)

MODE_DISABLE = 0.0
MODE_ABS = 1.0
MODE_VELOCITY = 2.0

# Control: what a controller hands to the power distribution.
CT_ROLL, CT_PITCH, CT_YAW, CT_THRUST = range(4)
CONTROL_SIZE = 4
