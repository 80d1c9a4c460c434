"""What is installed is what is in the folders."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_FOLDERS = ("crazyswarm_compat", "levels", "mocap", "runner", "safety", "sim_backend")


def test_every_folder_with_modules_is_declared():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    roots = {name: ROOT / folder for name, folder in declared["package-dir"].items()}
    installed = set()
    for package in declared["packages"]:
        name, rest = package, []
        while name not in roots:
            name, _, last = name.rpartition(".")
            rest.insert(0, last)
        folder = roots[name].joinpath(*rest)
        assert folder.is_dir(), f"{package}: no folder {folder}"
        installed.add(folder)
    present = {
        module.parent
        for folder in _FOLDERS
        for module in (ROOT / folder).rglob("*.py")
        if "__pycache__" not in module.parts
    }
    assert present <= installed, f"not declared: {sorted(map(str, present - installed))}"
