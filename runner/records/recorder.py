"""The flight recorder: one MCAP file an episode, on the episode's own time line.

Rows are copied into preallocated arrays during the flight and written in one go at the end, so
that recording costs a few microseconds a control step. Once a second of *wall* time what is
not yet on disk is handed to a thread that appends it to ``<file>.part`` (a valid beginning of
an MCAP file), so that even a killed process loses no more than that. The finished file holds
no wall-clock value: the same flight gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import InputError, StorageError
from crazyarena.runner.contestant.contract_2022.command_check import VERBS, Asked
from crazyarena.runner.judging import verdict_row
from crazyarena.runner.records import mcap_file
from crazyarena.runner.records.part_file import PartFile
from crazyarena.runner.timing.rows import Rows
from crazyarena.sim_backend.trace import TR_TIME, TRACE_SIZE
from crazyarena.whole_file import whole_file

SINCE = "0.1.0"
"""First version that wrote recordings like these: the same flight gives the same bytes in each
version since. Which one wrote a recording is in the ``result.json`` beside it."""

# Kinds of commands sent, by number: 0 is "nothing sent".
SENT_KINDS: tuple[type, ...] = get_args(cs.Command)
_KIND_NUMBER = {kind: i + 1 for i, kind in enumerate(SENT_KINDS)}

_ARGS = 13
_CM_ASKED = 1
_CM_SENT = 2 + _ARGS
COMMAND_SIZE = 3 + 2 * _ARGS

_STATE_FIELDS = """\
# One 2 ms tick; the state holds at this time. SI units, world frame, z up.
float64 time
float64[3] position
float64[4] orientation
float64[3] rpy
float64[3] velocity
float64[3] angular_velocity
float64[4] rotor_force
float64 contact
float64 tumbled
float64[3] setpoint_position
float64[3] setpoint_velocity
float64[3] setpoint_acceleration
float64 setpoint_yaw
"""
_COMMAND_FIELDS = """\
# One control step. asked: number of the contract's Command; sent: see the metadata "verbs".
# Arguments in the order of the contract, NaN where there is none.
float64 time
float64 asked
float64[13] asked_args
float64 sent
float64[13] sent_args
"""
_GATE_FIELDS = """\
# A gate that moves: where the cameras had it at a control step, if that has changed. m, rad; gate
# counts from 0; x, y, z of the opening's centre, fixed-axis roll, pitch, yaw.
float64 time
float64 gate
float64[6] pose
"""
_VEHICLE_FIELDS = """\
# What the vehicle tells of itself: battery V, commands of M1..M4 as shares of full scale, specific
# force in body axes, g.
float64 time
float64 battery
float64[4] motors
float64[3] acceleration
"""
_VEHICLE_SIZE = 9
# A PoseStamped whose frame id is "map": with its NUL the head is 16 bytes and needs no padding.
_POSE_FIELDS = """\
std_msgs/Header header
geometry_msgs/Pose pose
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_FRAME = b"map\0"
_POSE_ROW = np.dtype(
    [("sec", "<i4"), ("nanosec", "<u4"), ("length", "<u4"), ("frame", "S4"), ("pose", "<f8", 7)]
)
_EVENT_SCHEMA = {
    "type": "object",
    "properties": {
        "time": {"type": "number"},
        "tick": {"type": "integer"},
        "event": {"type": "string"},
        "detail": {"type": "string"},
    },
}

_STATE, _COMMAND, _REFEREE, _POSE, _EVENT, _SCENE, _GATE, _VEHICLE = range(1, 9)


def _ros(channel: int, topic: str, name: str, fields: str) -> mcap_file.Channel:
    return mcap_file.Channel(channel, topic, "cdr", name, "ros2msg", fields)


CHANNELS = [
    _ros(_STATE, "/state", "crazyarena/msg/State", _STATE_FIELDS),
    _ros(_COMMAND, "/command", "crazyarena/msg/Command", _COMMAND_FIELDS),
    _ros(_REFEREE, "/referee", "crazyarena/msg/Verdict", verdict_row.FIELDS),
    _ros(_POSE, "/pose", "geometry_msgs/msg/PoseStamped", _POSE_FIELDS),
    mcap_file.Channel(
        _EVENT, "/event", "json", "crazyarena.Event", "jsonschema", json.dumps(_EVENT_SCHEMA)
    ),
    mcap_file.Channel(
        _SCENE, "/scene", "json", "foxglove.SceneUpdate", "jsonschema", '{"type":"object"}'
    ),
    _ros(_GATE, "/gate", "crazyarena/msg/Gate", _GATE_FIELDS),
]
# Only where a vehicle tells of itself: recordings of the competition's simulation stay as they are.
VEHICLE_CHANNEL = _ros(_VEHICLE, "/vehicle", "crazyarena/msg/Vehicle", _VEHICLE_FIELDS)


def nanoseconds(seconds: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Episode time in s to integer ns."""
    return np.rint(seconds * 1e9).astype(np.uint64)


def _write_args(row: NDArray[np.float64], at: int, command: cs.Command | None) -> None:
    if isinstance(command, cs.FullState):  # fills all of them
        row[at : at + 3] = command.position
        row[at + 3 : at + 6] = command.velocity
        row[at + 6 : at + 9] = command.acceleration
        row[at + 9] = command.yaw
        row[at + 10 : at + 13] = command.omega
        return
    row[at : at + _ARGS] = np.nan
    match command:
        case cs.Takeoff() | cs.Land():
            row[at] = command.height
            row[at + 1] = command.duration
            if command.yaw is not None:
                row[at + 2] = command.yaw
        case cs.GoTo():
            row[at : at + 3] = command.position
            row[at + 3] = command.yaw
            row[at + 4] = command.duration
            row[at + 5] = command.relative
        case cs.Position():
            row[at : at + 3] = command.position
            row[at + 3] = command.yaw
        case cs.RollPitchYawThrust():
            row[at + 6 : at + 9] = command.roll, command.pitch, command.yaw
            row[at + 10] = command.thrust
        case cs.VelocityWorld():
            row[at : at + 3] = command.velocity
            row[at + 3] = command.yaw_rate
        case _:
            pass


class Recorder:
    """Records one episode.

    Parameters
    ----------
    file: where the finished recording goes; its folder must exist. None keeps it in memory.
    metadata: strings that describe the flight; no wall-clock values.
    scene: a ``foxglove.SceneUpdate`` of the true track (see :mod:`.scene`).
    wall: clock that decides when to append to the ``.part`` file.
    logs: there is a channel for what the vehicle tells of itself.

    Attributes
    ----------
    file: where the recording is: in the end the ``.part`` file if the disk refused the whole one.
    trouble: that refusal in words, or None.

    Raises
    ------
    InputError: the ``.part`` file cannot be written.
    """

    def __init__(
        self,
        file: Path | None,
        metadata: Mapping[str, str],
        scene: Mapping[str, Any],
        wall: Clock,
        flush_period: float = 1.0,
        logs: bool = False,
    ) -> None:
        self._channels = [*CHANNELS, VEHICLE_CHANNEL] if logs else CHANNELS
        self.file = file
        self._metadata = dict(metadata)
        self._wall = wall
        self._flush_period = flush_period
        self._flushed_at = wall.now()
        self.trouble: str | None = None
        self._part: PartFile | None = None
        if file is not None:
            # Now, and not in flight: a thread is confined as the one that starts it.
            part = file.with_name(file.name + ".part")
            try:
                self._part = PartFile(part, mcap_file.preamble(self._channels, "crazyarena"))
            except OSError as error:
                raise InputError(
                    f"{part}: cannot write the recording: {error.strerror}. Make room, pass "
                    "another --out, or fly with --no-record"
                ) from error
        self._states = Rows(TRACE_SIZE, 17408)
        self._commands = Rows(COMMAND_SIZE, 1024)
        self._verdicts = Rows(verdict_row.SIZE, 1024)
        self._pose_index: list[int] = []
        self._events: list[tuple[int, bytes]] = []
        self._scenes: list[tuple[int, bytes]] = [(0, json.dumps(scene).encode())]
        self._gates = Rows(8, 64)
        self._vehicle = Rows(_VEHICLE_SIZE, 2048 if logs else 1)
        self._on_disk = [0] * _VEHICLE
        self._closed = False

    def command(self, time: float, asked: Asked, sent: cs.Command | None) -> None:
        """Store what was asked for at a control step, and what went to the backend."""
        row = self._commands.next()
        row[0] = time
        row[_CM_ASKED] = asked.verb
        _write_args(row, _CM_ASKED + 1, asked.command)
        row[_CM_SENT] = 0 if sent is None else _KIND_NUMBER[type(sent)]
        if sent is asked.command:
            row[_CM_SENT + 1 :] = row[_CM_ASKED + 1 : _CM_ASKED + 1 + _ARGS]
        else:
            _write_args(row, _CM_SENT + 1, sent)

    def step(self, rows: NDArray[np.float64], verdict: NDArray[np.float64]) -> None:
        """Store the ticks of a control step (k, TRACE_SIZE) and the referee's verdict on them."""
        self._states.extend(rows)
        self._pose_index.append(self._states.count - 1)
        self._verdicts.next()[:] = verdict
        now = self._wall.now()
        if now - self._flushed_at >= self._flush_period:
            self._flushed_at = now
            self.flush()

    def epilogue(self, rows: NDArray[np.float64]) -> None:
        """Store ticks (k, TRACE_SIZE) that nobody judges: the way home."""
        self._states.extend(rows)

    def event(self, time: float, tick: int, name: str, detail: str = "") -> None:
        """Store something that happened at one tick."""
        text = json.dumps({"time": time, "tick": tick, "event": name, "detail": detail})
        self._events.append((round(time * 1e9), text.encode()))

    def gate(self, time: float, gate: int, pose: NDArray[np.float64]) -> None:
        """Store where a gate that moves is: (6,) m, rad."""
        row = self._gates.next()
        row[:2] = time, gate
        row[2:] = pose

    def vehicle(self, rows: NDArray[np.float64]) -> None:
        """Store what the vehicle told of itself (k, 9); dropped unless it ``logs``."""
        if self._channels is not CHANNELS:
            self._vehicle.extend(rows)

    def scene(self, time: float, scene: Mapping[str, Any]) -> None:
        """Store a further ``foxglove.SceneUpdate``."""
        self._scenes.append((round(time * 1e9), json.dumps(scene).encode()))

    def _batches(self, first: list[int], last: list[int]) -> list[mcap_file.Batch]:
        """Messages number ``first`` (inclusive) to ``last`` (exclusive) of every channel."""
        states = self._states.between(first[0], last[0])
        commands = self._commands.between(first[1], last[1])
        verdicts = self._verdicts.between(first[2], last[2])
        posed = self._states.take(self._pose_index[first[3] : last[3]])
        times = nanoseconds(posed[:, TR_TIME])
        poses = np.zeros(len(posed), _POSE_ROW)
        poses["sec"] = times // 10**9
        poses["nanosec"] = times % 10**9
        poses["length"] = len(_FRAME)
        poses["frame"] = _FRAME
        poses["pose"] = posed[:, 1:8]
        batches = [
            mcap_file.cdr_batch(_STATE, first[0], nanoseconds(states[:, TR_TIME]), states),
            mcap_file.cdr_batch(_COMMAND, first[1], nanoseconds(commands[:, 0]), commands),
            mcap_file.cdr_batch(_REFEREE, first[2], nanoseconds(verdicts[:, 0]), verdicts),
            mcap_file.cdr_batch(_POSE, first[3], times, poses),
        ]
        for i in range(first[4], last[4]):
            batches.append(mcap_file.message(_EVENT, i, *self._events[i]))
        for i in range(first[5], last[5]):
            batches.append(mcap_file.message(_SCENE, i, *self._scenes[i]))
        gates = self._gates.between(first[6], last[6])
        batches.append(mcap_file.cdr_batch(_GATE, first[6], nanoseconds(gates[:, 0]), gates))
        told = self._vehicle.between(first[7], last[7])
        if len(told):
            times = nanoseconds(np.maximum(told[:, 0], 0.0))
            batches.append(mcap_file.cdr_batch(_VEHICLE, first[7], times, told))
        return batches

    def _counts(self) -> list[int]:
        return [
            self._states.count,
            self._commands.count,
            self._verdicts.count,
            len(self._pose_index),
            len(self._events),
            len(self._scenes),
            self._gates.count,
            self._vehicle.count,
        ]

    def flush(self) -> None:
        """Append what is not on disk yet to the ``.part`` file; nobody waits for the disk."""
        if self._part is None:
            return
        counts = self._counts()
        self._part.append(batch.data for batch in self._batches(self._on_disk, counts))
        self._on_disk = counts

    def close(self) -> None:
        """Write the finished file and drop the ``.part`` file. Idempotent.

        Where the disk refuses, the ``.part`` file stays, with as much of the flight as it takes.
        """
        if self._closed or self.file is None or self._part is None:
            return
        self._closed = True
        counts = self._counts()
        try:
            # What a loss of power takes of a dry run of 2022, flying it again gives back.
            with whole_file(self.file, sync=self._channels is not CHANNELS) as stream:
                writer = mcap_file.McapWriter(stream, self._channels)
                writer.metadata("crazyarena", self._metadata)
                verbs = {f"asked {number}": name for name, number in VERBS.items()}
                sent = set(self._commands.rows[:, _CM_SENT].tolist())
                verbs |= {
                    f"sent {number}": kind.__name__
                    for kind, number in _KIND_NUMBER.items()
                    # Recordings without it stay as they always were.
                    if kind is not cs.RollPitchYawThrust or number in sent
                }
                writer.metadata("verbs", verbs)
                writer.chunk(self._batches([0] * _VEHICLE, counts))
                writer.finish()
        except StorageError as error:
            self._keep_part(error)
            return
        self._part.close()
        self._part.path.unlink()

    def _keep_part(self, error: StorageError) -> None:
        assert self._part is not None
        self.flush()
        share = "the whole flight" if self._part.close_complete() is None else "its beginning"
        self.file = self._part.path
        self.trouble = f"{error}; {share} is in {self.file}, which exports as any recording"

    # What figures and reports need of the flight just recorded.
    @property
    def states(self) -> NDArray[np.float64]:
        """(n, TRACE_SIZE) ticks recorded so far."""
        return self._states.rows

    @property
    def first_scene(self) -> dict[str, Any]:
        """The ``foxglove.SceneUpdate`` that the flight began in."""
        scene: dict[str, Any] = json.loads(self._scenes[0][1])
        return scene

    @property
    def commanded_from(self) -> float:
        """When the first command went to the vehicle, s; inf if none did."""
        commands = self._commands.rows
        sent = np.flatnonzero(commands[:, _CM_SENT])
        return float(commands[sent[0], 0]) if len(sent) else float("inf")
