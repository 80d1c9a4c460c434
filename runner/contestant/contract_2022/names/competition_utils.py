"""The helpers that competition controllers import as ``competition_utils``.

Loaded only when a submission has no file of that name. SI units, radians, world z up.
"""

from __future__ import annotations

import math
import os
import time
from enum import Enum
from functools import wraps

import numpy as np

__all__ = [
    "Command",
    "PIDController",
    "draw_trajectory",
    "plot_trajectory",
    "thrusts",
    "timing_ep",
    "timing_step",
]


class Command(Enum):
    """Verbs that ``cmdFirmware`` may return together with a list of arguments."""

    FINISHED = -1  # []
    NONE = 0  # []
    FULLSTATE = 1  # [position 3, velocity 3, acceleration 3, yaw, body rates 3]
    TAKEOFF = 2  # [height, duration]
    LAND = 3  # [height, duration]
    STOP = 4  # []
    GOTO = 5  # [[x, y, z], yaw, duration, relative]
    NOTIFYSETPOINTSTOP = 6  # []


def _rotation(quaternion):
    """Return the body-to-world matrix of a quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _rpy(rotation):
    return np.array(
        [
            math.atan2(rotation[2, 1], rotation[2, 2]),
            math.asin(max(-1.0, min(1.0, -rotation[2, 0]))),
            math.atan2(rotation[1, 0], rotation[0, 0]),
        ]
    )


def _quaternion_from_rpy(rpy):
    (sr, sp, sy), (cr, cp, cy) = np.sin(np.asarray(rpy) / 2), np.cos(np.asarray(rpy) / 2)
    return np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


class PIDController:
    """Cascaded position and attitude PID that returns rotor speeds (sim-only mode).

    The attitude error is the vee map of the skew part of the rotation error (Lee et al.,
    CDC 2010).
    """

    def __init__(
        self,
        g=9.8,
        m=0.027,
        kf=3.16e-10,
        km=7.94e-12,
        pwm2rpm_scale=0.2685,
        pwm2rpm_const=4070.3,
        min_pwm=20000,
        max_pwm=65535,
        p_coeff_for=(0.4, 0.4, 1.25),
        i_coeff_for=(0.05, 0.05, 0.05),
        d_coeff_for=(0.2, 0.2, 0.5),
        p_coeff_tor=(70000.0, 70000.0, 60000.0),
        i_coeff_tor=(0.0, 0.0, 500.0),
        d_coeff_tor=(20000.0, 20000.0, 12000.0),
    ):
        self.g, self.m, self.kf, self.km = g, m, kf, km
        self.pwm2rpm_scale, self.pwm2rpm_const = pwm2rpm_scale, pwm2rpm_const
        self.min_pwm, self.max_pwm = min_pwm, max_pwm
        self.p_coeff_for = np.array(p_coeff_for, dtype=float)
        self.i_coeff_for = np.array(i_coeff_for, dtype=float)
        self.d_coeff_for = np.array(d_coeff_for, dtype=float)
        self.p_coeff_tor = np.array(p_coeff_tor, dtype=float)
        self.i_coeff_tor = np.array(i_coeff_tor, dtype=float)
        self.d_coeff_tor = np.array(d_coeff_tor, dtype=float)
        # Rotors front-left, back-left, back-right, front-right; columns roll, pitch, yaw.
        self.mixer = np.array(
            [[0.5, -0.5, 1.0], [0.5, 0.5, -1.0], [-0.5, 0.5, 1.0], [-0.5, -0.5, -1.0]]
        )
        self.reset()

    def reset(self):
        """Forget integrals and the previous attitude."""
        self.last_rpy = np.zeros(3)
        self.integral_pos_e = np.zeros(3)
        self.integral_rpy_e = np.zeros(3)

    def compute_control(
        self,
        control_timestep,
        cur_pos,
        cur_quat,
        cur_vel,
        cur_ang_vel,
        target_pos,
        target_rpy=(0.0, 0.0, 0.0),
        target_vel=(0.0, 0.0, 0.0),
        target_rpy_rates=(0.0, 0.0, 0.0),
    ):
        """Return (rpm (4,), position error (3,) m, yaw error rad)."""
        rotation = _rotation(cur_quat)
        pos_e = np.asarray(target_pos, dtype=float) - cur_pos
        vel_e = np.asarray(target_vel, dtype=float) - cur_vel
        self.integral_pos_e = np.clip(
            self.integral_pos_e + pos_e * control_timestep, [-2, -2, -0.15], [2, 2, 0.15]
        )
        force = (
            self.p_coeff_for * pos_e
            + self.i_coeff_for * self.integral_pos_e
            + self.d_coeff_for * vel_e
            + np.array([0.0, 0.0, self.g * self.m])
        )
        along_body = max(0.0, float(force @ rotation[:, 2]))
        thrust_pwm = (math.sqrt(along_body / (4 * self.kf)) - self.pwm2rpm_const) / (
            self.pwm2rpm_scale
        )
        z_axis = force / np.linalg.norm(force)
        y_axis = np.cross(z_axis, [math.cos(target_rpy[2]), math.sin(target_rpy[2]), 0.0])
        y_axis /= np.linalg.norm(y_axis)
        desired = np.column_stack([np.cross(y_axis, z_axis), y_axis, z_axis])

        rpy = _rpy(rotation)
        skew = desired.T @ rotation - rotation.T @ desired
        rot_e = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        rates_e = np.asarray(target_rpy_rates, dtype=float) - (
            (rpy - self.last_rpy) / control_timestep
        )
        self.last_rpy = rpy
        self.integral_rpy_e = np.clip(
            self.integral_rpy_e - rot_e * control_timestep, [-1, -1, -1500], [1, 1, 1500]
        )
        torques = np.clip(
            -self.p_coeff_tor * rot_e
            + self.d_coeff_tor * rates_e
            + self.i_coeff_tor * self.integral_rpy_e,
            -3200,
            3200,
        )
        pwm = np.clip(thrust_pwm + self.mixer @ torques, self.min_pwm, self.max_pwm)
        rpm = self.pwm2rpm_scale * pwm + self.pwm2rpm_const
        return rpm, pos_e, _rpy(desired)[2] - rpy[2]


def timing_step(method):
    """Account the wall time of ``interStepLearn`` on the controller."""

    @wraps(method)
    def timed(self, *args, **kwargs):
        start = time.perf_counter()
        result = method(self, *args, **kwargs)
        elapsed = time.perf_counter() - start
        self.interstep_learning_time += elapsed
        self.interstep_learning_occurrences += 1
        if elapsed >= self.CTRL_TIMESTEP:
            print(
                f"WARNING: interStepLearn took {elapsed:.4f} s, "
                f"the control period is {self.CTRL_TIMESTEP:.4f} s"
            )
        if self.VERBOSE and self.interstep_learning_occurrences % 15 == 0:
            average = self.interstep_learning_time / self.interstep_learning_occurrences
            print(f"interStepLearn: {elapsed:.6f} s this time, {average:.6f} s on average")
        return result

    return timed


def timing_ep(method):
    """Store the wall time of ``interEpisodeLearn`` on the controller."""

    @wraps(method)
    def timed(self, *args, **kwargs):
        start = time.perf_counter()
        result = method(self, *args, **kwargs)
        self.interepisode_learning_time = time.perf_counter() - start
        if self.VERBOSE:
            print(f"interEpisodeLearn: {self.interepisode_learning_time:.6f} s")
        return result

    return timed


def thrusts(controller, ctrl_timestep, kf, obs, target, target_v):
    """Return the four rotor forces (N) of a :class:`PIDController`; ``obs`` is the full state."""
    rpm, _, _ = controller.compute_control(
        control_timestep=ctrl_timestep,
        cur_pos=np.array([obs[0], obs[2], obs[4]]),
        cur_quat=_quaternion_from_rpy([obs[6], obs[7], obs[8]]),
        cur_vel=np.array([obs[1], obs[3], obs[5]]),
        cur_ang_vel=np.array([obs[9], obs[10], obs[11]]),
        target_pos=target,
        target_vel=target_v,
    )
    return kf * rpm**2


def plot_trajectory(t_scaled, waypoints, ref_x, ref_y, ref_z):
    """Show a reference over time and in space, two seconds each."""
    import matplotlib.pyplot as plt

    waypoints = np.asarray(waypoints)
    figure, axes = plt.subplots(3, 1, sharex=True)
    for axis, values, label in zip(axes, (ref_x, ref_y, ref_z), "xyz", strict=True):
        axis.plot(t_scaled, values)
        axis.set_ylabel(f"{label} [m]")
        axis.grid(True)
    axes[-1].set_xlabel("time [s]")
    plt.show(block=False)
    plt.pause(2)
    plt.close(figure)

    figure = plt.figure()
    axis = figure.add_subplot(projection="3d")
    axis.plot(ref_x, ref_y, ref_z)
    axis.scatter(waypoints[:, 0], waypoints[:, 1], waypoints[:, 2])
    plt.show(block=False)
    plt.pause(2)
    plt.close(figure)


def draw_trajectory(initial_info, waypoints, ref_x, ref_y, ref_z):
    """Draw a sphere per waypoint and about fifty line pieces in the PyBullet client."""
    import pybullet

    client = initial_info["pyb_client"]
    sphere = os.path.join(initial_info["urdf_dir"], "sphere.urdf")
    for point in waypoints:
        pybullet.loadURDF(sphere, list(point)[:3], [0, 0, 0, 1], physicsClientId=client)
    step = max(1, len(ref_x) // 50)
    for i in range(step, len(ref_x), step):
        pybullet.addUserDebugLine(
            lineFromXYZ=[ref_x[i - step], ref_y[i - step], ref_z[i - step]],
            lineToXYZ=[ref_x[i], ref_y[i], ref_z[i]],
            lineColorRGB=[1, 0, 0],
            physicsClientId=client,
        )
