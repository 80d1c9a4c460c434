"""A script as its author runs it, with cameras that take the nose for elsewhere: over UDP,
guarded and not."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.runner.stage import Stage

HOVER = Path(__file__).resolve().parents[3] / "examples" / "crazyswarm" / "hover.py"
FLEET = "crazyflies:\n- {id: 1, channel: 100, initialPosition: [0, 0, 0]}\n"


def fly(folder: Path, degrees: float, *flags: str) -> tuple[int, str, np.ndarray]:
    """Exit code, what it said, and the highest and furthest that the vehicle came, m."""
    shutil.copy(HOVER, folder)
    (folder / "crazyflies.yaml").write_text(FLEET)
    reached = np.zeros(2)
    with Stage("level0", places=[(0.0, 0.0)], noses={"cf1": math.radians(degrees)}) as stage:
        advance = stage.swarm.advance

        def seen(ticks, send):
            advance(ticks, send)
            x, y, z = stage.fleet.true_pose(0).position
            np.maximum(reached, [z, math.hypot(x, y)], out=reached)

        stage.swarm.advance = seen
        done = subprocess.run(
            [sys.executable, "hover.py", "--backend", "radio", "--uri", stage.uris[0],
             "--mocap", f"zenoh:{stage.endpoint}", *flags],
            cwd=folder,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=240,
            check=False,
        )  # fmt: skip
    return done.returncode, done.stderr, reached


@pytest.mark.slow
@pytest.mark.parametrize("guard", ["none", "level0"])
@pytest.mark.parametrize("degrees", [90, -45, 180])
def test_far_turned_is_cut_close_to_where_it_stood(tmp_path, degrees, guard):
    code, said, (height, way) = fly(tmp_path, degrees, "--guard", guard)
    assert code == 1, said
    assert "the body is turned by" in said
    assert height < 0.3
    assert way < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("guard", ["none", "level0"])
def test_a_little_turned_is_told_and_flown(tmp_path, guard):
    code, said, (height, _) = fly(tmp_path, 20, "--guard", guard)
    assert code == 0, said
    assert "the body is turned by +" in said
    assert height > 0.9
