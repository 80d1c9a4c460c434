"""What the firmware silently takes otherwise than it reads, in words for whoever calls it."""

MELLINGER = 2  # of stabilizer.controller

IGNORED = "the firmware says yes to such a start and does nothing"
NOT_NOTIFIED = (
    "follows streamed setpoints without notifySetpointsStop(); a Crazyflie in Crazyswarm ignores "
    "it: call notifySetpointsStop() first"
)
VELOCITY_WITH_MELLINGER = (
    "velocities are not followed by the Mellinger controller (it holds height at most, and sinks "
    "to the floor with cmdVelocityWorld); set stabilizer/controller to 1 (PID)"
)
