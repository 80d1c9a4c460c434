"""Layout of the referee's verdict on one control step: a float64 row.

Written by the compiled referee, copied as it stands into the recording.
"""

VD_TIME = 0  # s since the episode began, of the last tick
VD_TICKS = 1  # ticks completed
VD_GATE = 2  # next gate, -1 when all are passed
VD_GATE_TYPE = 3  # 0 tall, 1 low, -1 when all are passed
VD_IN_RANGE = 4
VD_GATE_POSE = 5  # the 6 numbers told to the contestant; NaN when all are passed
VD_AT_GOAL = 11
VD_COMPLETED = 12
VD_CONTACT = 13  # contact code of sim_backend.trace
VD_VIOLATION = 14
VD_REWARD = 15
VD_DONE = 16
VD_TRUNCATED = 17  # NaN, or 1.0/0.0 at the time limit: ended by nothing but the limit
VD_TUMBLED = 18
VD_MSE = 19  # squared distance to the goal, m²
VD_CONSTRAINTS = 20  # 8 on the input, 6 on the state
SIZE = 34

FIELDS = """\
# The referee's verdict after one control step; constraints: 8 on the input, 6 on the state.
float64 time
float64 ticks
float64 target_gate
float64 target_gate_type
float64 in_range
float64[6] gate_pose
float64 at_goal
float64 task_completed
float64 contact
float64 violation
float64 reward
float64 done
float64 truncated
float64 tumbled
float64 mse
float64[14] constraint_values
"""
