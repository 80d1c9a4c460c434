"""The cache of compiled kernels: shared by installations of the same sources, never stale."""

import os
import subprocess
import sys

import pytest

SOURCE = """\
from crazyarena.jit import kernel

@kernel
def twice(x):
    return {factor} * x
"""
RUN = """\
import sys
sys.path.insert(0, sys.argv[1])
import some_kernels
print(some_kernels.twice(21.0), sum(some_kernels.twice.stats.cache_hits.values()))
"""


@pytest.fixture
def run(tmp_path):
    """Call the kernel of an installation in folder ``name``; returns result and cache hits."""

    def call(name, factor=2.0):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        (folder / "some_kernels.py").write_text(SOURCE.format(factor=factor))
        done = subprocess.run(
            [sys.executable, "-c", RUN, str(folder)],
            # Python tells its own compiled files by size and second.
            env={
                **os.environ,
                "XDG_CACHE_HOME": str(tmp_path / "cache"),
                "PYTHONDONTWRITEBYTECODE": "1",
            },
            capture_output=True,
            text=True,
            check=True,
        )
        result, hits = done.stdout.split()
        return float(result), int(hits)

    return call


def test_the_same_sources_elsewhere_are_compiled_already(run):
    assert run("here") == (42.0, 0)
    assert run("here") == (42.0, 1)
    assert run("there") == (42.0, 1)


def test_changed_sources_are_compiled_anew(run):
    assert run("here") == (42.0, 0)
    assert run("here", factor=3.0) == (63.0, 0)
    assert run("there", factor=3.0) == (63.0, 1)


def test_a_broken_cache_is_made_anew(run, tmp_path):
    run("here")
    files = list((tmp_path / "cache").rglob("some_kernels*.nb*")) + [
        file for file in (tmp_path / "cache").rglob("*.nb?") if "some_kernels" in str(file.parent)
    ]
    assert files
    for file in files:
        file.write_bytes(b"")
    assert run("here")[0] == 42.0
