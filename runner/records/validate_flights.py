"""Flights of real vehicles as logs of what was asked of them and where they were.

Three kinds of files: recordings of ours (``.mcap``), NumPy archives (``.npz``) and tables with
named columns (``.csv``). SI units; yaw in rad.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.runner.records import export
from crazyarena.runner.records.validate_archive import unpacked
from crazyarena.runner.records.validate_commands import end_of, read_commands, sent_command
from crazyarena.runner.records.validate_units import check_units

Array = NDArray[np.float64]
Commands = tuple[tuple[float, c.Command], ...]

CONTROLLERS = {"pid": 1, "mellinger": 2, "mell": 2}
_FORMS = "recordings (.mcap), archives (.npz) or tables (.csv)"
_SHORTEST = 20  # poses and commands that make a flight


@dataclass(frozen=True, slots=True)
class Series:
    """Samples (n, ...) of something at times (n,) s; n may be 0."""

    time: Array
    value: Array

    def __len__(self) -> int:
        return len(self.time)

    def at(self, time: Array) -> Array:
        """Linear interpolation of every column."""
        columns = self.value.reshape(len(self.time), -1).T
        return np.stack([np.interp(time, self.time, column) for column in columns], axis=-1)


EMPTY = Series(np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True)
class RealFlight:
    """What was logged of one flight; all times on one clock, s.

    Attributes
    ----------
    pose: position (n, 3) m of the tracked body.
    commands: what was sent to the vehicle, by time.
    setpoint: position (k, 3) m where the commands are setpoints, streamed or from on board.
    motors: (n, 4) commands of M1..M4 as shares of full scale; volts: (n,) battery;
        acceleration: (n, 3) g, specific force in body axes; attitude: (n, 4) quaternions x, y, z,
        w; gyro: (n, 3) rad/s, body axes; rotors: (n, 4) rad/s. Each may be empty.
    controller: 1 PID, 2 Mellinger.
    """

    name: str
    file: Path
    pose: Series
    commands: Commands
    setpoint: Series
    controller: int
    motors: Series = field(default=EMPTY)
    volts: Series = field(default=EMPTY)
    acceleration: Series = field(default=EMPTY)
    attitude: Series = field(default=EMPTY)
    gyro: Series = field(default=EMPTY)
    rotors: Series = field(default=EMPTY)

    @property
    def start(self) -> float:
        """When the vehicle was first told to go somewhere, s."""
        return self.commands[0][0]

    @property
    def end(self) -> float:
        """When the last of it was flown, s."""
        return end_of(self.commands)


def find(paths: Sequence[Path]) -> list[Path]:
    """Files of flights: those named, and those in the folders named.

    Raises
    ------
    InputError: a path is missing, of another kind, or a folder holds none.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = [
                *sorted(path.glob("*.npz")),
                *sorted(path.glob("*.csv")),
                *sorted(path.rglob("*.mcap")),
            ]
            if not inside:
                raise InputError(f"{path}: holds no flights; expected {_FORMS}")
            files += inside
        elif not path.exists():
            raise InputError(f"{path}: no such file or folder; expected {_FORMS}")
        elif path.suffix not in (".npz", ".csv", ".mcap"):
            raise InputError(f"{path}: not a kind of file that is read; expected {_FORMS}")
        else:
            files.append(path)
    return files


def load(file: Path, controller: str | None = None, *, high_level: bool = False) -> RealFlight:
    """Read one flight.

    Parameters
    ----------
    controller: ``pid`` or ``mellinger``, where the file does not say.
    high_level: setpoints came from the planner on board: velocities and accelerations that are
        not logged follow from the positions.

    Raises
    ------
    InputError: naming file, field and remedy.
    """
    readers = {".npz": _npz, ".csv": _csv, ".mcap": _mcap}
    return readers[file.suffix](file, controller, high_level)


def _controller(file: Path, given: str | None, told: str | None) -> int:
    name = given or told
    if name is None:
        stem = file.stem.lower()
        name = next((key for key in ("mell", "pid") if key in stem), None)
    if name is None:
        raise InputError(f"{file}: controller: not in the file; pass --controller pid or mellinger")
    try:
        return CONTROLLERS[name.strip().lower()]
    except KeyError:
        raise InputError(
            f"{file}: controller: found {name!r}; expected one of pid, mellinger"
        ) from None


# Archives: name, factor to SI, columns. The first name that is there counts.
_NPZ: dict[str, tuple[tuple[tuple[str, float], ...], int, str]] = {
    "position": ((("pos_0p1mm", 1e-4), ("pos", 1.0), ("position", 1.0)), 3, "m"),
    "setpoint": ((("setpoint_0p1mm", 1e-4), ("setpoint", 1.0)), 3, "m"),
    "velocity": ((("setpoint_vel", 1.0), ("setpoint_velocity", 1.0)), 3, "m/s"),
    "acceleration": ((("setpoint_acc", 1.0), ("setpoint_acceleration", 1.0)), 3, "m/s^2"),
    "yaw": ((("setpoint_yaw_cdeg", np.pi / 18000.0), ("setpoint_yaw", 1.0)), 1, "rad"),
    "motors": ((("motors_u16", 1.0 / 65535.0), ("motors", 1.0)), 4, "shares of full scale"),
    "volts": ((("vbat_mV", 1e-3), ("vbat", 1.0)), 1, "V"),
    "accelerometer": ((("acc_mg", 1e-3), ("acc_g", 1.0), ("acc", 1.0 / 9.81)), 3, "g"),
    "attitude": ((("quat_1e4", 1e-4), ("quat", 1.0), ("attitude", 1.0)), 4, "quaternions"),
    "gyro": ((("gyro_dps", np.pi / 180.0), ("gyro", 1.0)), 3, "rad/s"),
    "rotors": ((("rotors_rpm", np.pi / 30.0), ("rotors", 1.0)), 4, "rad/s"),
}


def _npz(file: Path, controller: str | None, high_level: bool) -> RealFlight:
    held = unpacked(file)
    time = _npz_time(file, held)
    fields: dict[str, Series] = {}
    for name, (names, columns, unit) in _NPZ.items():
        key = next(((key, scale) for key, scale in names if key in held), None)
        if key is not None:
            fields[name] = _npz_field(file, held, key, columns, unit, time)
    commands = _npz_commands(file, held)
    for name in ("position",) if commands else ("position", "setpoint"):
        if name not in fields:
            wanted = " or ".join(key for key, _ in _NPZ[name][0])
            wanted += " (or command and command_t)" if name == "setpoint" else ""
            found = ", ".join(held) or "nothing"
            raise InputError(f"{file}: {name}: missing; expected an array {wanted}, found {found}")
    told = str(held["controller"]) if "controller" in held else None
    return _assemble(file, fields, _controller(file, controller, told), high_level, commands)


def _npz_commands(file: Path, held: dict[str, Any]) -> Commands:
    """What a script told the planner on board, where the archive says."""
    if "command" not in held:
        return ()
    if "command_t" not in held:
        raise InputError(f"{file}: command_t: missing; expected the times of command, in s")
    words = np.asarray(held["command"]).reshape(-1)
    times = _numbers(file, "command_t", held["command_t"]).reshape(-1)
    if words.dtype.kind != "U" or len(words) != len(times):
        raise InputError(
            f"{file}: command: expected texts, as many as command_t ({len(times)}), found "
            f"{words.shape} of {words.dtype}"
        )
    return read_commands(
        file, [(float(times[k]), str(words[k]), f"command[{k}]") for k in range(len(words))]
    )


def _npz_time(file: Path, held: dict[str, Any]) -> Array:
    key = "t" if "t" in held else "time"
    if key not in held:
        raise InputError(f"{file}: t: missing; expected times (n,) in s")
    return _rising(file, key, np.asarray(_numbers(file, key, held[key]), np.float64).reshape(-1))


def _numbers(file: Path, key: str, value: Any) -> Array:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}: {key}: expected numbers, found {value.dtype}") from error


def _rising(file: Path, key: str, time: Array) -> Array:
    wrong = np.flatnonzero(~np.isfinite(time) | np.concatenate(([False], np.diff(time) < 0.0)))
    if len(wrong):
        raise InputError(
            f"{file}: {key}[{wrong[0]}]: expected finite times that do not fall, found "
            f"{time[wrong[0]]:g}; cut the log there"
        )
    return time


def _npz_field(
    file: Path, held: dict[str, Any], found: tuple[str, float], columns: int, unit: str, time: Array
) -> Series:
    key, scale = found
    value = _numbers(file, key, held[key])
    if value.ndim == 1 and columns == 1:
        value = value[:, None]
    if value.ndim != 2 or value.shape[1] != columns or not len(value):
        raise InputError(f"{file}: {key}: expected (n, {columns}) {unit}, found {value.shape}")
    # Slower streams have every k-th time.
    every = max(1, round(len(time) / len(value)))
    own = time[::every]
    if abs(len(own) - len(value)) > 1:
        raise InputError(
            f"{file}: {key}: expected {len(time)} rows, or every k-th of them, found {len(value)}"
        )
    count = min(len(own), len(value))
    value = value[:count] * scale
    if key.endswith("setpoint_0p1mm"):
        value[(value == 0.0).all(axis=1)] = np.nan
    return Series(own[:count], value)


# Tables: names of columns that mean the same.
_TIME = ("t", "time", "timestamp")
_AXES = {
    "position": (("x", "y", "z"), ("pos_{}", "position_{}", "p{}", "{}", "stateEstimate.{}")),
    "setpoint": (
        ("x", "y", "z"),
        ("sp_{}", "setpoint_{}", "setpoint_position_{}", "target_{}", "ctrltarget.{}"),
    ),
    "velocity": (("x", "y", "z"), ("sp_v{}", "setpoint_v{}", "ctrltarget.v{}")),
    "acceleration": (("x", "y", "z"), ("sp_a{}", "setpoint_a{}", "ctrltarget.a{}")),
    "yaw": (("yaw",), ("sp_{}", "setpoint_{}")),
    "motors": (("m1", "m2", "m3", "m4"), ("{}", "motor.{}", "motor_{}", "pwm_{}")),
    "volts": (("vbat",), ("{}", "pm.{}")),
    "accelerometer": (("x", "y", "z"), ("acc_{}", "acc.{}")),
    "attitude": (("x", "y", "z", "w"), ("q{}", "quat_{}", "stateEstimate.q{}")),
    "gyro": (("x", "y", "z"), ("gyro_{}", "gyro.{}")),
    "rotors": (("m1", "m2", "m3", "m4"), ("rpm_{}", "rpm.{}")),
}


def _csv(file: Path, controller: str | None, high_level: bool) -> RealFlight:
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: cannot read this table: {error}") from error
    if len(rows) < 2:
        raise InputError(f"{file}: expected a line of column names and rows, found {len(rows)}")
    names = [name.strip().lstrip("#").strip() for name in rows[0]]
    table = np.full((len(rows) - 1, len(names)), np.nan)
    told = None
    words: list[tuple[int, str]] = []
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        if len(row) != len(names):
            raise InputError(f"{file}:{number}: expected {len(names)} columns, found {len(row)}")
        for at, text in enumerate(row):
            if names[at] == "controller":
                told = text or told
            elif names[at] == "command":
                if text.strip():
                    words.append((number, text.strip()))
            elif text.strip():
                try:
                    table[number - 2, at] = float(text)
                except ValueError:
                    raise InputError(
                        f"{file}:{number}: {names[at]}: expected a number or nothing, found "
                        f"{text[:40]!r}"
                    ) from None
    column = {name: table[:, at] for at, name in enumerate(names)}
    key = next((name for name in _TIME if name in column), None)
    if key is None:
        raise InputError(f"{file}: t: missing; expected a column t in s, found {', '.join(names)}")
    timed = np.isfinite(column[key])
    time = _rising(file, key, column[key][timed])
    fields: dict[str, Series] = {}
    for name, (axes, forms) in _AXES.items():
        form = next((f for f in forms if all(f.format(axis) in column for axis in axes)), None)
        if form is not None:
            value = np.stack([column[form.format(axis)][timed] for axis in axes], axis=-1)
            fields[name] = _csv_field(name, form, Series(time, value))
    commands = read_commands(
        file, [(float(column[key][n - 2]), text, f"line {n}, command") for n, text in words]
    )
    for name in ("position",) if commands else ("position", "setpoint"):
        if name not in fields:
            axes, forms = _AXES[name]
            wanted = " or ".join(", ".join(f.format(a) for a in axes) for f in forms[:2])
            raise InputError(
                f"{file}: {name}: missing; expected columns {wanted}, found {', '.join(names)}"
            )
    return _assemble(file, fields, _controller(file, controller, told), high_level, commands)


def _csv_field(name: str, form: str, series: Series) -> Series:
    value = series.value
    full = np.isfinite(value).all(axis=1)
    series = Series(series.time[full], value[full])
    if name == "motors" and len(series) and series.value.max() > 1.5:
        return Series(series.time, series.value / 65535.0)
    if name == "accelerometer" and form == "acc_{}":
        return Series(series.time, series.value / 9.81)
    if name == "gyro" and form == "gyro.{}":
        return Series(series.time, np.radians(series.value))
    if name == "rotors":
        return Series(series.time, series.value * np.pi / 30.0)
    return series


def _assemble(
    file: Path,
    fields: dict[str, Series],
    controller: int,
    high_level: bool,
    told: Commands = (),
) -> RealFlight:
    """The flight; ``told`` was told to the planner on board, and is flown instead of setpoints."""
    pose = fields["position"]
    seen = np.isfinite(pose.value).all(axis=1)
    pose = Series(pose.time[seen], pose.value[seen])
    check_units(file, {name: (series.time, series.value) for name, series in fields.items()})
    target = fields.get("setpoint", EMPTY)
    if len(target):
        given = np.isfinite(target.value).all(axis=1)
        target = Series(target.time[given], target.value[given])
    for name, series in (("position", pose), ("setpoint", target)):
        if len(series) < _SHORTEST and not (name == "setpoint" and told):
            raise InputError(
                f"{file}: {name}: expected at least {_SHORTEST} samples, found {len(series)}"
            )
    return RealFlight(
        file.stem,
        file,
        pose,
        told or tuple(_streamed(target, fields, high_level)),
        target,
        controller,
        motors=fields.get("motors", EMPTY),
        volts=_flat(fields.get("volts", EMPTY)),
        acceleration=fields.get("accelerometer", EMPTY),
        attitude=fields.get("attitude", EMPTY),
        gyro=fields.get("gyro", EMPTY),
        rotors=fields.get("rotors", EMPTY),
    )


def _streamed(
    target: Series, fields: dict[str, Series], high_level: bool
) -> list[tuple[float, c.Command]]:
    """Logged setpoints as the commands they were."""
    velocity, acceleration = fields.get("velocity"), fields.get("acceleration")
    if high_level and velocity is None:
        velocity, acceleration = _derivatives(target)
    yaw = np.zeros(len(target))
    if "yaw" in fields:
        yaw = fields["yaw"].at(target.time)[:, 0]
    commands: list[tuple[float, c.Command]] = []
    if velocity is None:
        for time, position, heading in zip(target.time, target.value, yaw, strict=True):
            commands.append((float(time), c.Position(tuple(position), float(heading))))
    else:
        fast = velocity.at(target.time)
        pulls = np.zeros_like(fast) if acceleration is None else acceleration.at(target.time)
        for time, position, v, a, heading in zip(
            target.time, target.value, fast, pulls, yaw, strict=True
        ):
            commands.append(
                (
                    float(time),
                    c.FullState(
                        tuple(position), tuple(v), tuple(a), float(heading), (0.0, 0.0, 0.0)
                    ),
                )
            )
    return commands


def _flat(series: Series) -> Series:
    return Series(series.time, series.value.reshape(-1))


def _derivatives(target: Series) -> tuple[Series, Series]:
    """Velocity and acceleration of logged positions, by local cubics over 0.3 s."""
    from scipy.signal import savgol_filter

    step = 0.01
    grid = np.arange(target.time[0], target.time[-1], step)
    if len(grid) < 31:
        zeros = Series(target.time, np.zeros_like(target.value))
        return zeros, zeros
    at = target.at(grid)
    velocity = savgol_filter(at, 31, 3, deriv=1, delta=step, axis=0)
    acceleration = savgol_filter(at, 31, 3, deriv=2, delta=step, axis=0)
    return Series(grid, velocity), Series(grid, acceleration)


def _mcap(file: Path, controller: str | None, high_level: bool) -> RealFlight:
    recording = export.read(file)
    states, sent = recording.tables.get("state"), recording.tables.get("command")
    if states is None or len(states) < _SHORTEST or sent is None or not len(sent):
        raise InputError(f"{file}: holds no flight: too few poses or no commands")
    names = recording.columns["state"]
    place, turn = names.index("position_0"), names.index("orientation_0")
    time = states[:, names.index("time")]
    kept = np.concatenate(([True], np.diff(time) > 0.0))
    pose = Series(time[kept], states[kept, place : place + 3])
    columns = recording.columns["command"]
    kind, first = columns.index("sent"), columns.index("sent_args_0")
    commands: list[tuple[float, c.Command]] = []
    targets: list[tuple[float, Array]] = []
    for row in sent:
        command = sent_command(int(row[kind]), row[first:])
        if command is not None:
            commands.append((float(row[0]), command))
            if isinstance(command, c.FullState | c.Position):
                targets.append((float(row[0]), np.asarray(row[first : first + 3])))
    if not commands:
        raise InputError(f"{file}: holds no command that a vehicle could follow")
    setpoint = EMPTY
    if targets:
        setpoint = Series(np.array([t for t, _ in targets]), np.array([p for _, p in targets]))
    told = None if controller is not None else "mellinger"
    return RealFlight(
        f"{file.parent.name}/{file.stem}",
        file,
        pose,
        tuple(commands),
        setpoint,
        _controller(file, controller, told),
        attitude=Series(time[kept], states[kept, turn : turn + 4]),
        **_told(recording),
    )


def _told(recording: export.Recording) -> dict[str, Series]:
    """What the vehicle told of itself."""
    rows = recording.tables.get("vehicle")
    if rows is None or len(rows) < _SHORTEST:
        return {}
    time = rows[:, 0]
    return {
        "volts": Series(time, rows[:, 1]),
        "motors": Series(time, rows[:, 2:6]),
        "acceleration": Series(time, rows[:, 6:9]),
    }
