"""The command-line flags that every script understands, without the script knowing them."""

from __future__ import annotations

import argparse
import copy
import math
import os
import sys
import warnings
from collections.abc import Sequence

from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.registry import ENTRIES, SIMULATED
from crazyarena.errors import InputError

# Perfect tracking is made for ten frames per second; dynamics need commands between frames.
DEFAULT_DT = 0.1
DEFAULT_DT_DYNAMICS = 0.01
# What --guard says for scripts that are started by something else.
GUARD_VARIABLE = "CRAZYARENA_GUARD"
NO_GUARD = "none"
NO_MOCAP = "none"


class CrazyswarmWarning(UserWarning):
    """A call or flag that does nothing here, or not what it does on other backends."""


def warn(message: str, stacklevel: int = 3) -> None:
    warnings.warn(message, CrazyswarmWarning, stacklevel=stacklevel + 1)


def build_argparser(
    parent_parsers: Sequence[argparse.ArgumentParser] = (),
) -> argparse.ArgumentParser:
    """Parser of the flags; ``parent_parsers`` (made with ``add_help=False``) add theirs."""
    parser = argparse.ArgumentParser(parents=list(parent_parsers))
    parser.add_argument("--sim", action="store_true", help="simulate instead of using the radio")
    parser.add_argument(
        "--backend",
        choices=sorted(ENTRIES),
        help="what flies: ideal (perfect tracking, the meaning of --sim alone), sim (firmware "
        "and physics), pybullet, or radio (without --sim)",
    )
    parser.add_argument(
        "--vis",
        default="mpl",
        choices=["mpl", "vispy", "viser", "null"],
        help="[sim] viewer (vispy is taken as mpl)",
    )
    parser.add_argument(
        "--dt",
        type=float,
        default=None,
        help=f"[sim] tick and frame period in s (default {DEFAULT_DT} ideal, "
        f"{DEFAULT_DT_DYNAMICS} otherwise)",
    )
    parser.add_argument("--writecsv", action="store_true", help="write logcf<id>.csv per vehicle")
    parser.add_argument(
        "--disturbance", type=float, default=0.0, help="[sim] std. dev. of velocity noise, m/s"
    )
    parser.add_argument(
        "--maxvel", type=float, default=math.inf, help="[sim] limit on the speed, m/s"
    )
    parser.add_argument(
        "--downwash",
        action="store_true",
        help="[sim] let vehicles push down on those below them (not with --backend ideal)",
    )
    parser.add_argument(
        "--vehicle",
        metavar="NAME|FILE",
        help="[sim] vehicle model of every vehicle, e.g. cf21plus or a file, instead of those of "
        "the vehicle list (not with --backend ideal)",
    )
    parser.add_argument(
        "--vehicle-set",
        metavar="FIELD=VALUE",
        action="append",
        default=[],
        help="[sim] override a field of the vehicle model, e.g. body.mass=0.035 (repeatable)",
    )
    parser.add_argument("--video", metavar="PATH", help="[sim] write a film of the viewer")
    parser.add_argument(
        "--record",
        metavar="DIR",
        help="write cf<id>.mcap for every vehicle and flight.png, as dry runs do (crazyarena "
        "replay, export, compare)",
    )
    parser.add_argument(
        "--crazyflies-yaml", "--crazyflies_yaml", metavar="PATH", help="vehicle list to use"
    )
    parser.add_argument(
        "--uri",
        metavar="URI[,URI...]",
        help="[radio] links of the vehicles in file order, e.g. udp://127.0.0.1:19850, instead "
        "of those of the vehicle list",
    )
    parser.add_argument(
        "--mocap",
        metavar="SOURCE[:HOST]",
        help="[radio] forward poses from here and prepare the vehicles before the script starts, "
        "e.g. vicon:192.168.1.2 or zenoh:tcp/127.0.0.1:7447; onboard: they have positioning decks; "
        "none: as without it, whatever motion_capture.yaml of Crazyswarm2 says",
    )
    parser.add_argument(
        "--watchdog",
        action="store_true",
        help="[radio, with --mocap] arm the onboard emergency-stop watchdog: motors stop one "
        "second after this program dies, ends or loses the link; then restart the vehicle",
    )
    parser.add_argument(
        "--guard",
        metavar="ARENA[,KEY=VALUE...]",
        help="fly under the safety of the arena: command gate, fence, watchdog and emergency stop. "
        "ARENA is a level or a file with an arena; keys are policy (clamp or refuse), seed (of "
        "simulated cameras) and every safety limit. --sim then means --backend sim; real vehicles "
        f"need --mocap. Also {GUARD_VARIABLE}=ARENA, or 'guard: ARENA' in the vehicle list; "
        f"'{NO_GUARD}' overrides both",
    )
    return parser


def parse(
    args: str | Sequence[str] | None, parent_parser: argparse.ArgumentParser | None
) -> argparse.Namespace:
    """Parse ``args`` (text, list, or None for ``sys.argv``); unknown flags are ignored.

    ``backend`` is filled in, ``dt`` too.

    Raises
    ------
    InputError
        naming the flag.
    """
    parser = build_argparser([] if parent_parser is None else [parent_parser])
    if args is None:
        args = sys.argv[1:]
    elif isinstance(args, str):
        args = args.split()
    parsed, _ = parser.parse_known_args(args)
    parsed.guard = parsed.guard or os.environ.get(GUARD_VARIABLE) or None
    return _completed(parsed)


def with_guard_of(parsed: argparse.Namespace, fleet: FleetConfig) -> argparse.Namespace:
    """The flags with the guard of the vehicle list, if they name none themselves."""
    if fleet.guard is None or parsed.given.guard is not None:
        return parsed
    given = copy.copy(parsed.given)
    given.guard = fleet.guard
    return _completed(given)


def _completed(given: argparse.Namespace) -> argparse.Namespace:
    """A copy in which what was left out is filled in and contradictions are refused."""
    parsed = copy.copy(given)
    parsed.given = given
    if parsed.guard == NO_GUARD:
        parsed.guard = None
    if parsed.mocap == NO_MOCAP:
        parsed.mocap = None
    if parsed.backend is None:
        # Perfect tracking has no dynamics: nothing could be guarded there.
        simulated = "ideal" if parsed.guard is None else "sim"
        parsed.backend = simulated if parsed.sim else "radio"
    elif parsed.sim and parsed.backend not in SIMULATED:
        raise InputError(f"--sim: contradicts --backend {parsed.backend}; give one of the two")
    parsed.sim = parsed.backend in SIMULATED
    if parsed.guard is not None:
        if parsed.backend == "ideal":
            raise InputError(
                "--guard: perfect tracking has no dynamics to guard; use --backend sim or pybullet"
            )
        if not parsed.sim and parsed.mocap is None:
            raise InputError("--guard: watches real vehicles by their poses; add --mocap")
    if parsed.dt is None:
        parsed.dt = DEFAULT_DT if parsed.backend == "ideal" else DEFAULT_DT_DYNAMICS
    if not (math.isfinite(parsed.dt) and parsed.dt > 0):
        raise InputError(f"--dt: found {parsed.dt}; expected seconds > 0")
    if not parsed.disturbance >= 0 or math.isinf(parsed.disturbance):
        raise InputError(f"--disturbance: found {parsed.disturbance}; expected m/s >= 0")
    if not parsed.maxvel > 0:
        raise InputError(f"--maxvel: found {parsed.maxvel}; expected m/s > 0")
    if not parsed.sim:
        for flag in ("writecsv", "video"):
            if getattr(parsed, flag):
                warn(f"--{flag} only works in simulation and is ignored")
    else:
        for flag in ("uri", "mocap", "watchdog"):
            if getattr(parsed, flag):
                raise InputError(
                    f"--{flag}: only --backend radio knows it; leave it out in simulation"
                )
    if parsed.vis == "vispy" and parsed.sim:
        warn("--vis vispy: there is no vispy viewer here; using --vis mpl")
        parsed.vis = "mpl"
    if parsed.sim and parsed.video and parsed.vis != "mpl":
        raise InputError(f"--video: found --vis {parsed.vis}; films need --vis mpl")
    return parsed
