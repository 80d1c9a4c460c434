"""Hands the blocks out to workers and takes the results in: dask.distributed.

Without a scheduler an embedded cluster of processes as wide as the processors; with one, whatever
workers it has. A worker that dies is replaced by dask and its block flown again; one that is unfit
is given nothing more. At no time is more under way than the workers need.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from crazyarena.errors import CrazyarenaError, DependencyMissing, InputError
from crazyarena.runner.tournament.flight import Flown, Order
from crazyarena.runner.tournament.worker import Answer, identity, work

_CONNECT = 10.0  # s
_JOIN = 60.0  # s, for the first worker
_LOOK = 0.25  # s, between looks while nothing comes back
_ATTEMPTS = 4  # for a block, by workers that die or fail
_AHEAD = 2  # blocks under way for each worker, so that none waits for the organiser


class SchedulerLost(CrazyarenaError):
    """The scheduler is gone; what came back before is safe."""


@dataclass
class _Try:
    order: Order
    attempt: int = 0
    data: bytes | None = None
    to: str | None = None


class Engine:
    """A cluster, entered as a context.

    Parameters
    ----------
    scheduler: address, such as ``tcp://host:8786``; None: an embedded cluster.
    workers: of the embedded one; None: as many as processors.
    measured: thinking counts: fewer workers, each with two processors of its own.
    say: told of what is worth telling.

    Attributes
    ----------
    failed: blocks that no worker could fly, with the reason. unfit: why, by worker.
    dashboard: address of dask's own page; None without.

    Raises
    ------
    DependencyMissing: dask.distributed is not installed. InputError: nobody answers.
    """

    def __init__(
        self,
        scheduler: str | None = None,
        workers: int | None = None,
        *,
        measured: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        try:
            import distributed
        except ImportError:
            raise DependencyMissing("distributed", "tournament", "a tournament") from None
        self._dask: Any = distributed
        self._scheduler = scheduler
        self._measured = measured
        cores = sorted(os.sched_getaffinity(0))
        self._pins: dict[str, list[int]] = {}
        if measured:
            workers = workers or max(1, len(cores) // 2)
            if 2 * workers <= len(cores):
                self._pins = {str(k): cores[2 * k : 2 * k + 2] for k in range(workers)}
        self._count = workers or len(cores)
        self._say = say
        self.failed: list[tuple[Order, str]] = []
        self.unfit: dict[str, str] = {}
        self.dashboard: str | None = None
        self._stack = contextlib.ExitStack()
        self._client: Any = None

    def __enter__(self) -> Engine:
        with contextlib.ExitStack() as stack:
            self._open(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._stack.close()

    def _open(self, stack: contextlib.ExitStack) -> None:
        import dask

        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        settings: dict[str, Any] = {
            "distributed.scheduler.allowed-failures": _ATTEMPTS,
            "distributed.comm.timeouts.connect": f"{_CONNECT:g}s",
            "distributed.admin.large-graph-warning-threshold": "2GiB",
        }
        stack.enter_context(dask.config.set(settings))
        target: Any = self._scheduler
        if self._scheduler is None:
            target = self._dask.LocalCluster(
                n_workers=self._count,
                threads_per_worker=1,
                processes=True,
                silence_logs=logging.CRITICAL,
                dashboard_address=_dashboard(),
            )
            stack.callback(target.close)
        try:
            self._client = self._dask.Client(target, timeout=_CONNECT)
        except (OSError, TimeoutError, ValueError, ImportError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(
                f"--scheduler {self._scheduler}: nobody answers ({reason}). Start one with: "
                "dask scheduler"
            ) from None
        stack.callback(self._client.close, timeout=2)
        if _dashboard() is not None:
            self.dashboard = self._client.dashboard_link
        self._wait_for_workers()

    def _wait_for_workers(self) -> None:
        deadline = time.monotonic() + _JOIN
        told = False
        while not self.workers():
            if time.monotonic() > deadline:
                raise InputError(
                    f"--scheduler {self._scheduler}: no workers joined within {_JOIN:g} s. Start "
                    f"some, on every machine: dask worker {self._scheduler} --nthreads 1 "
                    "--nworkers auto"
                )
            if not told and self._scheduler is not None:
                self._say(f"waiting for workers at {self._scheduler}")
                told = True
            time.sleep(_LOOK)

    def workers(self) -> dict[str, int]:
        """Threads of the workers that the scheduler has, by address."""
        try:
            found: dict[str, int] = self._client.nthreads()
        except (OSError, TimeoutError):
            raise self._lost() from None
        return found

    def run(
        self,
        orders: Iterable[Order],
        archives: Path,
        on_flown: Callable[[Order, Flown, dict[str, Any]], None],
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        """Have every order flown; ``on_flown`` is told as they come back.

        Parameters
        ----------
        archives: folder of the submissions. on_flown: gets order, result and the worker's identity;
            what it raises ends the run. tick: called a few times a second.

        Raises
        ------
        SchedulerLost: the scheduler is gone. InputError: no worker is fit.
        """
        wanted = {**identity(), "pins": self._pins}
        near = str(archives.resolve())
        waiting = iter(orders)
        again: deque[_Try] = deque()
        running: dict[Any, _Try] = {}
        more = True
        threads = self._threads()
        try:
            while more or again or running:
                while (more or again) and len(running) < _AHEAD * threads:
                    attempt = again.popleft() if again else None
                    if attempt is None:
                        order = next(waiting, None)
                        if order is None:
                            more = False
                            break
                        attempt = _Try(order)
                    running[self._submit(attempt, wanted, near)] = attempt
                tick()
                if not running:
                    continue
                for future in self._done(running):
                    attempt = running.pop(future)
                    answer = self._answer(future, attempt, again)
                    if answer is not None:
                        self._take(answer, attempt, again, archives, on_flown)
                    future.release()
                threads = self._threads()
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel(list(running), force=True)

    def _threads(self) -> int:
        return max(1, sum(self.workers().values()))

    def _submit(self, attempt: _Try, wanted: dict[str, Any], near: str) -> Any:
        where: dict[str, Any] = {}
        fit = [address for address in self.workers() if address not in self.unfit]
        if attempt.to is not None and attempt.to in fit:
            where = {"workers": [attempt.to], "allow_other_workers": True}
        elif self.unfit and fit:
            where = {"workers": fit, "allow_other_workers": True}
        elif self.unfit and self.workers():
            raise InputError(_nobody(self.unfit))
        return self._client.submit(
            work,
            attempt.order,
            wanted,
            near,
            attempt.data,
            pure=False,
            key=f"{attempt.order.key}-{attempt.attempt}-{time.monotonic_ns()}",
            **where,
        )

    def _done(self, running: dict[Any, _Try]) -> list[Any]:
        with contextlib.suppress(TimeoutError):
            self._dask.wait(list(running), timeout=_LOOK, return_when="FIRST_COMPLETED")
        if self._client.status not in ("running", "connecting"):
            raise self._lost()
        done = [future for future in running if future.status != "pending"]
        if not done and self._client.scheduler is None:
            raise self._lost()
        return done

    def _lost(self) -> SchedulerLost:
        return SchedulerLost(
            f"the scheduler {self._scheduler or 'of the embedded cluster'} is gone. What was flown "
            "is safe; start again with the same --out"
        )

    def _answer(self, future: Any, attempt: _Try, again: deque[_Try]) -> Answer | None:
        if future.status == "finished":
            try:
                answer = future.result(timeout=_JOIN)
                assert isinstance(answer, Answer)
                return answer
            except (OSError, TimeoutError) as error:
                reason = f"{type(error).__name__}: {error}"
        elif future.status in ("cancelled", "lost"):
            if self._client.status != "running":
                raise self._lost()
            reason = "its result was lost"
        else:
            raised = future.exception()
            reason = f"{type(raised).__name__}: {raised}"
        if attempt.attempt + 1 >= _ATTEMPTS:
            self.failed.append((attempt.order, reason))
        else:
            again.append(replace(attempt, attempt=attempt.attempt + 1, data=None, to=None))
        return None

    def _take(
        self,
        answer: Answer,
        attempt: _Try,
        again: deque[_Try],
        archives: Path,
        on_flown: Callable[[Order, Flown, dict[str, Any]], None],
    ) -> None:
        address = answer.worker.get("address", "")
        if answer.unfit is not None:
            if address not in self.unfit:
                host = answer.worker.get("host", "")
                self._say(f"worker {address} on {host} is given no work: {answer.unfit}")
            self.unfit[address] = answer.unfit
            again.append(replace(attempt, data=None, to=None))
        elif answer.lacks:
            data = (archives / f"{attempt.order.archive}.tar").read_bytes()
            again.appendleft(replace(attempt, data=data, to=address))
        else:
            assert answer.flown is not None
            on_flown(attempt.order, answer.flown, answer.worker)


def _nobody(unfit: dict[str, str]) -> str:
    reasons = "; ".join(sorted(set(unfit.values())))
    return f"no worker is fit to fly: {reasons}"


def _dashboard() -> str | None:
    return None if importlib.util.find_spec("bokeh") is None else "127.0.0.1:0"
