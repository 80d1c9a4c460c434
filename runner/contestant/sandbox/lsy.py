"""A controller of lsy_drone_racing in a process of its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from crazyarena.runner.contestant.contract_lsy.dialogue import LsyAnswer, LsyQuestion, Observation
from crazyarena.runner.contestant.contract_lsy.submission import bundle_root, controller_hash
from crazyarena.runner.contestant.dialogue import Answer
from crazyarena.runner.contestant.sandbox.box import Box
from crazyarena.runner.contestant.sandbox.limits import Limits
from crazyarena.runner.contestant.sandbox.process import Sandboxed

_PATIENCE = 30.0  # s of wall time for one answer; on virtual time nobody waits for it


class LsySandboxed(Sandboxed):
    """An :class:`~crazyarena.runner.contestant.contract_lsy.dialogue.LsyContestant` behind walls.

    The file is copied with all that lies beside it: checkpoints, and the modules of its package.
    Raises as :class:`Sandboxed`.
    """

    def __init__(
        self,
        file: Path,
        drone_model: str,
        limits: Limits | None = None,
        *,
        require: bool = False,
        parameters: Mapping[str, object] | None = None,
        patience: float | None = None,
    ) -> None:
        self._model = drone_model
        self._wants = False
        self._patience = _PATIENCE if patience is None else patience
        super().__init__(file, limits, require=require, parameters=parameters)

    def _copied(self) -> tuple[Path, str, Box]:
        box = Box(self.path, self._limits.copy_size, bundle_root(self.path))
        return self.path, controller_hash(self.path), box

    def _loading(self) -> object:
        return self._model

    def make(  # type: ignore[override]
        self, obs: Observation, config: dict[str, Any], info: dict[str, Any] | None = None
    ) -> None:
        # The seed would tell what nobody has seen yet.
        if self._step is not None and self.wait(self._limits.make_timeout) is None:
            self.kill()  # it still thinks about the last question of an earlier episode
        if self._process is None or self._process.poll() is not None:
            self._renew()
        env = {**config.get("env", {}), "seed": -1}
        told = {"parameters": self._parameters} if self._parameters else {}
        payload = (obs, {**config, "env": env, **told}, info)
        self._request("make", payload, self._limits.make_timeout, "the controller's constructor")

    def put(self, question: LsyQuestion) -> None:
        """Put a question; returns at once."""
        self._wants = question.obs is not None
        super().ask(question)  # type: ignore[arg-type]

    def take(self, timeout: float) -> LsyAnswer | None:
        """The answer, or None if there is none within ``timeout`` s of wall time."""
        answer: Any = self.wait(timeout)
        if answer is None:
            return None
        if isinstance(answer, Answer):
            return LsyAnswer(answer.step, error=answer.error or "no answer", seconds=answer.seconds)
        if self._wants and not answer.finished and answer.command is None:
            self.kill()
            return LsyAnswer(answer.step, error=f"step {answer.step}: it sent no command")
        return answer

    def ask(self, question: LsyQuestion) -> LsyAnswer:  # type: ignore[override]
        self.put(question)
        answer = self.take(self._patience)
        if answer is None:
            self.kill()
            return LsyAnswer(
                question.step,
                error=f"step {question.step}: no answer within {self._patience:g} s",
            )
        return answer
