"""A controller to start from. Copy this folder, edit it, then: crazyarena dry-run FOLDER

The runner makes one ``Controller`` and flies all episodes with it. The module may import what
lies beside it; ``competition_utils`` is yours if you bring one, else ours.

Units: m, s, rad, N, kg; world frame x forward, y left, z up.
"""

from __future__ import annotations

import numpy as np
from competition_utils import Command, timing_ep, timing_step


class Controller:
    """Flies to the goal in a straight line: takeoff, one go-to, hover.

    Parameters
    ----------
    initial_obs: [x, 0, y, 0, z, 0, phi, theta, psi, 0, 0, 0], as every later ``obs``.
    initial_info: dict; among others ``ctrl_timestep`` (s), ``nominal_gates_pos_and_type``
        ([x, y, 0, r, p, yaw, type] each), ``nominal_obstacles_pos``, ``gate_dimensions``,
        ``x_reference`` (12,), the goal as a state, ``nominal_physical_parameters``.
    use_firmware: True: ``cmdFirmware`` will be called.
    """

    def __init__(
        self, initial_obs, initial_info, use_firmware=False, buffer_size=100, verbose=False
    ):
        self.CTRL_TIMESTEP = initial_info["ctrl_timestep"]
        self.CTRL_FREQ = initial_info["ctrl_freq"]
        self.VERBOSE = verbose
        self.BUFFER_SIZE = buffer_size
        self.goal = np.array(initial_info["x_reference"])[0:5:2]
        self.reset()
        self.interEpisodeReset()

    def reset(self):
        """Forget what belongs to one episode. Called here only, by you."""
        self.sent = set()
        self.interstep_counter = 0
        self.interepisode_counter = 0

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        """Choose what the vehicle does next; called every 1/30 s.

        Parameters
        ----------
        time: s since the episode began; 0.0 marks a new episode.
        obs: as ``initial_obs``. At time 0 of later episodes still the last one before.
        reward, done: of the last step.
        info: dict; ``current_target_gate_id``, ``_type``, ``_in_range`` and ``_pos``
            ([x, y, z, r, p, yaw], exact only when in range), ``at_goal_position``,
            ``task_completed``, ``collision``, ... Empty at time 0.

        Returns
        -------
        (Command, args): ``NONE []``, ``FULLSTATE [pos, vel, acc, yaw, body rates]``,
        ``TAKEOFF [height, duration]``, ``LAND [height, duration]``, ``STOP []``,
        ``GOTO [[x, y, z], yaw, duration, relative]``, ``NOTIFYSETPOINTSTOP []`` (before a GOTO
        or LAND that follows FULLSTATE) or ``FINISHED []``.
        """
        if time == 0.0:
            self.sent.clear()
        if "takeoff" not in self.sent:
            self.sent.add("takeoff")
            return Command.TAKEOFF, [1.5, 2.0]
        if time >= 2.5 and "goto" not in self.sent:
            self.sent.add("goto")
            return Command.GOTO, [self.goal + [0.0, 0.0, 0.5], 0.0, 5.0, False]
        return Command.NONE, []

    def cmdSimOnly(self, time, obs, reward=None, done=None, info=None):
        """Part of the contract of 2022, for flights without firmware; not called here."""
        raise NotImplementedError

    @timing_step
    def interStepLearn(self, action, obs, reward, done, info):
        """Learn from a step; its wall time counts.

        ``action`` (4,) N; ``obs`` (12,) is the full true state here, velocities and all.
        """
        self.interstep_counter += 1

    @timing_ep
    def interEpisodeLearn(self):
        """Learn from an episode; its wall time counts."""
        self.interepisode_counter += 1

    def interEpisodeReset(self):
        """Zero the timers before the next episode."""
        self.interstep_learning_time = 0
        self.interstep_learning_occurrences = 0
        self.interepisode_learning_time = 0
