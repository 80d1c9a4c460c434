"""What a plan asks of motors and attitude: no more than the vehicle has, or it goes over.

Place over time tells the thrust, which is along the body's z, and so how fast the body has to tip
(differential flatness: Mellinger and Kumar, ICRA 2011). Firmware that flies a plan tells its
attitude loop these rates.
"""

from __future__ import annotations

import numpy as np

from crazyarena.safety.flight_model import GRAVITY, FlightModel
from crazyarena.safety.observation import Point
from crazyarena.safety.planner import Plan
from crazyarena.safety.steerable import LEAST_LIFT

_SLACK = 1.02  # what sampling may overlook


def overtaxed(
    plan: Plan, vehicle: FlightModel, least: int, step: float, now: Point = (0.0, 0.0, 0.0)
) -> str | None:
    """What is too much in a plan, in words; None if nothing is.

    ``least`` and ``step`` as for :meth:`Plan.samples`; with ``now``, m/s2, it may go on.
    """
    _, _, accelerations = plan.samples(least, step)
    begun = np.array(now) + (0.0, 0.0, GRAVITY)
    thrusts = accelerations + (0.0, 0.0, GRAVITY)
    sizes = np.linalg.norm(thrusts, axis=1)
    most = _SLACK * max(vehicle.lift * GRAVITY, float(np.linalg.norm(begun)))
    if not sizes.max() <= most:
        return (
            f"thrust reaches {sizes.max() / GRAVITY:.2f} times the weight, above {vehicle.lift:.2f}"
        )
    lowest = float(thrusts[:, 2].min())
    if not lowest >= min(LEAST_LIFT * GRAVITY / _SLACK, float(begun[2]) / _SLACK):
        return f"lift falls to {lowest / GRAVITY:.2f} times the weight, below {LEAST_LIFT:g}"
    jerks = plan.jerks(least, step)
    up = thrusts / sizes[:, None]
    across = jerks - (jerks * up).sum(axis=1)[:, None] * up
    rate = float((np.linalg.norm(across, axis=1) / sizes).max())
    if not rate <= _SLACK * vehicle.sharpest:
        return f"it tips the vehicle at {rate:.1f} rad/s, above {vehicle.sharpest:.1f}"
    return None
