"""Tumble detection of the 2022 firmware and of the competition around it.

(The 2026 firmware detects tumbling in its supervisor.) Either detector is a row of two numbers:
the length of the present run of samples below the threshold, and 1.0 once tumbled, for good.
"""

from __future__ import annotations

from crazyarena.jit import kernel

TB_COUNT = 0
TB_TUMBLED = 1
TUMBLE_SIZE = 2

_FIRMWARE_G, _FIRMWARE_LOOPS, _RUNNING = -0.5, 15, 1000.0
_COMPETITION_G, _COMPETITION_TICKS = -0.5, 30


@kernel
def tumble_2022(m, acc_z, motor_sum):
    """Update from the body z specific force (g) of one 1000 Hz loop; True once tumbled.

    ``motor_sum`` is the sum of the four motor commands (0..65535 each): only a vehicle with
    running motors is stopped.
    """
    if acc_z <= _FIRMWARE_G and motor_sum > _RUNNING:
        m[TB_COUNT] += 1.0
        if m[TB_COUNT] >= _FIRMWARE_LOOPS:
            m[TB_TUMBLED] = 1.0
    else:
        m[TB_COUNT] = 0.0
    return m[TB_TUMBLED] != 0.0


@kernel
def tumble_competition(m, acc_z_world):
    """Update from the world z acceleration plus 1 (g) of one 500 Hz tick; True once tumbled."""
    if acc_z_world < _COMPETITION_G:
        m[TB_COUNT] += 1.0
        if m[TB_COUNT] >= _COMPETITION_TICKS:
            m[TB_TUMBLED] = 1.0
    else:
        m[TB_COUNT] = 0.0
    return m[TB_TUMBLED] != 0.0
