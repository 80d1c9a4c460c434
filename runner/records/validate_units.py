"""Whether the numbers of a log can be in the units they are said to be in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError

Array = NDArray[np.float64]

# What every flight indoors has: least and most of the median size; how units are written.
_PLAUSIBLE = {
    "position": (0.0, 50.0, "m; 1e-4 m as pos_0p1mm"),
    "setpoint": (0.0, 50.0, "m; 1e-4 m as setpoint_0p1mm"),
    "velocity": (0.0, 20.0, "m/s"),
    "acceleration": (0.0, 60.0, "m/s^2"),
    "motors": (0.0, 1.01, "shares of full scale; 0 to 65535 as motors_u16"),
    "volts": (2.0, 30.0, "V; mV as vbat_mV"),
    "accelerometer": (0.2, 3.0, "m/s^2 as acc, g as acc_g or acc.x, 1e-3 g as acc_mg"),
    "attitude": (0.2, 1.8, "quaternions x, y, z, w; 1e-4 as quat_1e4"),
    "gyro": (0.0, 35.0, "rad/s; degrees/s as gyro_dps or gyro.x"),
}
_SLOWEST = 0.5  # s between poses


def check_units(file: Path, fields: Mapping[str, tuple[Array, Array]]) -> None:
    """Times (n,) s and values (n, ...) of every field that is logged.

    Raises
    ------
    InputError: naming file, field, what was found and the units that are read.
    """
    for name, (least, most, unit) in _PLAUSIBLE.items():
        if name not in fields or not len(fields[name][1]):
            continue
        value = fields[name][1].reshape(len(fields[name][1]), -1)
        size = np.abs(value).max(axis=1) if name == "motors" else np.linalg.norm(value, axis=1)
        if not np.isfinite(size).any():
            continue
        middle = float(np.nanmedian(size))
        if not least <= middle <= most:
            raise InputError(
                f"{file}: {name}: typical size {middle:.4g}, which no flight has; expected {unit}"
            )
    time = fields["position"][0]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if step > _SLOWEST:
        raise InputError(f"{file}: t: {step:g} from pose to pose; expected s")
