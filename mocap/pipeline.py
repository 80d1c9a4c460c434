"""Source to tracker to estimator to vehicles, in one loop that notices silence."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.estimator import BodyEstimate, FrameResult, PoseEstimator
from crazyarena.mocap.events import EventKind, MocapEvent
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.source import PoseSource, SourceState
from crazyarena.mocap.tracker import ConstellationTracker, SingleMarkerTracker, tracked_frame
from crazyarena.types import Pose, PoseFrame

OnFrame = Callable[[PoseFrame, FrameResult], None]
OnEvent = Callable[[MocapEvent], None]
# How late a loss of the source may be noticed by the thread, s.
_TICK = 0.01
# One event per so long while another publisher goes on, s.
_FOREIGN_AGAIN = 1.0


class PosePipeline:
    """Run every frame of a source through the estimator and on to whoever needs it.

    Either call :meth:`poll` from the loop that owns virtual time, or :meth:`start` a thread.
    Other threads may ask for estimates at any time.

    Parameters
    ----------
    source, estimator: where frames come from and who makes sense of them.
    clock: the session clock.
    tracker: turns unlabelled markers into bodies first.
    forwarder: gets every accepted pose.
    on_frame, on_event: called in the polling thread; the first with every frame (the recorder,
        the watchdog), the second with every event.
    stale_after: silence of the whole source, s, that raises an event.
    """

    def __init__(
        self,
        source: PoseSource,
        estimator: PoseEstimator,
        clock: Clock,
        *,
        tracker: SingleMarkerTracker | ConstellationTracker | None = None,
        forwarder: PoseForwarder | None = None,
        on_frame: Iterable[OnFrame] = (),
        on_event: Iterable[OnEvent] = (),
        stale_after: float = 0.15,
    ) -> None:
        if not stale_after > 0:
            raise InputError(f"mocap stale_after: found {stale_after}; need seconds above 0")
        self.source = source
        self.estimator = estimator
        self.forwarder = forwarder
        self._clock = clock
        self._tracker = tracker
        self._on_frame = tuple(on_frame)
        self._on_event = tuple(on_event)
        self._stale_after = stale_after
        self._lock = threading.Lock()
        self._last_received = clock.now()
        self._live: bool | None = None
        self._lost = 0
        self._reconnects = 0
        self._foreign = 0
        self._foreign_told = -math.inf
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.error: BaseException | None = None

    def poll(self, timeout: float = 0.0) -> int:
        """Process the frames that have arrived, waiting up to ``timeout`` s for the first.

        Returns the number of frames; raises what a callback raises.
        """
        frames = self.source.frames(timeout)
        for frame in frames:
            if self._tracker is not None:
                frame, _ = tracked_frame(frame, self._tracker)
            with self._lock:
                result = self.estimator.update(frame)
            if self.forwarder is not None:
                self.forwarder.submit(frame.timestamp, result.accepted, frame.received)
            for listener in self._on_frame:
                listener(frame, result)
            for event in result.events:
                self._tell(event)
        if self.forwarder is not None:
            self.forwarder.flush()
        self._watch(frames)
        return len(frames)

    def _tell(self, event: MocapEvent) -> None:
        for listener in self._on_event:
            listener(event)

    def _watch(self, frames: list[PoseFrame]) -> None:
        now = self._clock.now()
        status = self.source.status
        if frames:
            self._last_received = frames[-1].received
        if status.reconnects > self._reconnects:
            self._reconnects = status.reconnects
            self._tell(
                MocapEvent(now, EventKind.SOURCE_RECONNECTED, None, "motion capture reconnected")
            )
        if status.foreign > self._foreign and now - self._foreign_told >= _FOREIGN_AGAIN:
            count = status.foreign - self._foreign
            self._foreign, self._foreign_told = status.foreign, now
            message = f"{count} frames of another publisher were ignored ({status.error})"
            self._tell(MocapEvent(now, EventKind.FOREIGN_PUBLISHER, None, message))
        if status.lost + status.dropped > self._lost:
            missing = status.lost + status.dropped - self._lost
            self._lost += missing
            self._tell(MocapEvent(now, EventKind.FRAMES_LOST, None, f"{missing} frames were lost"))
        silence = now - self._last_received
        if frames and silence <= self._stale_after and self._live is not True:
            self._live = True
            self._tell(MocapEvent(now, EventKind.SOURCE_LIVE, None, "frames arrive"))
        elif silence > self._stale_after and self._live is not False:
            self._live = False
            reason = f" ({status.error})" if status.error else ""
            self._tell(
                MocapEvent(
                    now,
                    EventKind.SOURCE_STALE,
                    None,
                    f"no frame for {silence * 1e3:.0f} ms{reason}",
                )
            )
        with self._lock:
            events = self.estimator.check(now)
        for event in events:
            self._tell(event)

    @property
    def live(self) -> bool:
        """True while frames arrive in time."""
        return self._live is True

    def estimate(self, name: str, at: float | None = None) -> BodyEstimate:
        """Estimate of one body ``at`` a time of the session's clock, s; now by default."""
        time = self._clock.now() if at is None else at
        with self._lock:
            return self.estimator.estimate(name, time)

    def estimates(self) -> dict[str, BodyEstimate]:
        """Estimates of all bodies, now: for the watchdog and the recorder."""
        now = self._clock.now()
        with self._lock:
            return self.estimator.estimates(now)

    def poses(self) -> dict[str, Pose]:
        """Poses of all bodies that are not stale, now: for the referee and contestants."""
        now = self._clock.now()
        with self._lock:
            return self.estimator.poses(now)

    def start(self) -> None:
        """Poll in a thread until the source ends or :meth:`close` is called."""
        self.estimator.warm_up()
        self._last_received = self._clock.now()
        self._thread = threading.Thread(target=self._run, name="mocap", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                count = self.poll(_TICK)
                if not count and self.source.status.state is SourceState.CLOSED:
                    return
                if not count and self.source.status.state is SourceState.ENDED:
                    self._stop.wait(_TICK)
        except BaseException as error:
            # The owner sees it in `error`; poses go stale, which the watchdog acts upon.
            self.error = error
            self._tell(
                MocapEvent(
                    self._clock.now(),
                    EventKind.SOURCE_STALE,
                    None,
                    f"motion capture loop failed: {type(error).__name__}: {error}",
                )
            )

    def close(self) -> None:
        """Stop the thread, the forwarder and the source; within a second; idempotent."""
        self._stop.set()
        self.source.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=0.8)
        if self.forwarder is not None:
            self.forwarder.close()
