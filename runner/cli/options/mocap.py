"""What the motion-capture subcommands share."""

from __future__ import annotations

SOURCE_HELP = (
    "Where poses come from: vicon, qualisys, optitrack, vrpn, nokov, fzmotion, zenoh, ros2 or "
    "replay; for fly and preflight also onboard: the vehicle's own estimate."
)
HOST_HELP = "Host of the camera software, or zenoh endpoint such as tcp/10.0.0.5:7447."
OPTION_HELP = "Further option of the source, KEY=VALUE, under its own name (repeatable)."
