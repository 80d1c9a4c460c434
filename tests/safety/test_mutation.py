"""Taking out any one safeguard makes at least one test fail."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.safety import mutation_plugin

ROOT = Path(__file__).resolve().parents[2]
MUTATIONS = [
    *(f"rule:{name}" for name in mutation_plugin.rules()),
    *(f"gate:{name}" for name in mutation_plugin.checks()),
    *mutation_plugin.OTHERS,
]


GATE = ["test_gate.py", "test_attitudes.py", "test_release.py"]


def run_suite(mutation: str) -> subprocess.CompletedProcess[str]:
    kind = mutation.partition(":")[0]
    files = {"rule": ["test_monitors.py"], "gate": GATE}
    files |= {name: [file] for name, (_, file) in mutation_plugin.OTHERS.items()}
    names = files[kind] if kind else sorted({name for some in files.values() for name in some})
    return subprocess.run(
        [
            sys.executable,
            *("-m", "pytest", "-q", "-x", "-p", "tests.safety.mutation_plugin"),
            *("-p", "no:cacheprovider"),
            *(f"tests/{name}" if "/" in name else f"tests/safety/{name}" for name in names),
        ],
        cwd=ROOT,
        env={**os.environ, "SAFETY_MUTATION": mutation, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )


@pytest.mark.slow
def test_suite_passes_with_everything_in_place():
    result = run_suite("")
    assert result.returncode == 0, result.stdout[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("mutation", MUTATIONS)
def test_suite_notices_what_is_missing(mutation):
    result = run_suite(mutation)
    # 1: tests failed. Anything else is a suite that did not run.
    assert result.returncode == 1, result.stdout[-2000:]
