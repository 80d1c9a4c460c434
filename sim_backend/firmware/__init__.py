"""The on-board software of a Crazyflie as compiled kernels.

Written from the published control papers, the public protocol documentation and recorded
input/output numbers. Kernels work on rows of float64 arrays whose first axis is the vehicle;
the shared rows (state, setpoint, control) are laid out in :mod:`.layout`.
"""
