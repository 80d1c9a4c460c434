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
        self._patience = _PATIENCE if patience is None else patience
        super().__init__(file, limits, require=require, parameters=parameters)

    def _copied(self) -> tuple[Path, str, Box]:
        box = Box(self.path, self._limits.copy_size, bundle_root(self.path))
        return self.path, controller_hash(self.path), box

    def _loading(self) -> object:
        return self._model

    def make(self, obs: Observation, config: dict[str, Any]) -> None:  # type: ignore[override]
        # The seed would tell what nobody has seen yet.
        env = {**config.get("env", {}), "seed": -1}
        told = {"parameters": self._parameters} if self._parameters else {}
        payload = (obs, {**config, "env": env, **told})
        self._request("make", payload, self._limits.make_timeout, "the controller's constructor")

    def ask(self, question: LsyQuestion) -> LsyAnswer:  # type: ignore[override]
        super().ask(question)  # type: ignore[arg-type]
        answer: Any = self.wait(self._patience)
        if answer is None:
            self.kill()
            return LsyAnswer(
                question.step,
                error=f"step {question.step}: no answer within {self._patience:g} s",
            )
        if isinstance(answer, Answer):
            return LsyAnswer(answer.step, error=answer.error or "no answer", seconds=answer.seconds)
        wants = question.obs is not None and not answer.finished
        if wants and answer.command is None:
            self.kill()
            return LsyAnswer(question.step, error=f"step {question.step}: it sent no command")
        return answer
