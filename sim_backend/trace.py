"""What a simulated world reports of the ticks since it was last asked.

One float64 row per tick, so that a control period crosses from compiled code to Python (and
from there into the referee's kernel) as a single array. A pose source that only measures poses
fills the remaining columns with NaN; CONTACT is then UNKNOWN_CONTACT.
"""

from __future__ import annotations

TR_TIME = 0  # s since the episode began; the state holds *at* this time
TR_POS = 1  # m, world
TR_QUAT = 4  # x, y, z, w
TR_RPY = 8  # rad, fixed-axis XYZ (R = Rz Ry Rx)
TR_VEL = 11  # m/s, world
TR_OMEGA = 14  # rad/s, body
TR_ACTION = 17  # N, the four rotor forces asked of the plant during the tick,
#                 order front-left, back-left, back-right, front-right
TR_CONTACT = 21  # code of the first touched object, NO_CONTACT, or UNKNOWN_CONTACT
TR_TUMBLED = 22  # 1.0 when the firmware has declared the vehicle tumbled
TR_SETPOINT = 23  # position 3, velocity 3, acceleration 3 (SI, world), yaw rad
TRACE_SIZE = 33

# Contact codes: gate g is g, obstacle o is n_gates + o, the ground is n_gates + n_obstacles.
# That is also the order in which the competition looks for contacts.
NO_CONTACT = -1.0
UNKNOWN_CONTACT = -2.0
