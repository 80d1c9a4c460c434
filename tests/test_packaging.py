"""What is installed is what is in the folders."""

from __future__ import annotations

import fnmatch
import tomllib
from pathlib import Path

from setuptools import find_namespace_packages

from crazyarena import __version__
from crazyarena.runner.contestant.shipped import STARTERS

ROOT = Path(__file__).resolve().parent.parent
_FOLDERS = ("crazyswarm_compat", "levels", "mocap", "runner", "safety", "sim_backend")


def installed() -> dict[str, Path]:
    """Folder of every package that the wheel holds, links resolved."""
    find = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    rules = find["find"]
    return {
        package: (ROOT / where / package.replace(".", "/")).resolve()
        for where in rules["where"]
        for package in find_namespace_packages(
            str(ROOT / where), include=rules["include"], exclude=rules["exclude"]
        )
    }


def test_every_folder_with_modules_is_installed_once():
    folders = list(installed().values())
    present = {
        module.parent
        for folder in _FOLDERS
        for module in (ROOT / folder).rglob("*.py")
        if "__pycache__" not in module.parts
    }
    assert present <= set(folders), f"left out: {sorted(map(str, present - set(folders)))}"
    assert len(folders) == len(set(folders)), "a module would be in the wheel twice"


def test_the_wheel_holds_the_whole_of_what_new_copies():
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = (*rules["package-data"]["*"], "*.py")
    packages = installed()
    for name in STARTERS.values():
        folder = ROOT / "examples" / name
        assert folder in packages.values()
        left_out = [
            f.name
            for f in folder.iterdir()
            if f.is_file() and not any(fnmatch.fnmatch(f.name, pattern) for pattern in patterns)
        ]
        assert not left_out


def test_the_version_is_one():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_each_folder_is_followed_from_the_package():
    for folder in _FOLDERS:
        link = ROOT / "crazyarena" / folder
        assert link.is_symlink(), f"{link}: with git, core.symlinks must be true"
        assert link.readlink() == Path("..") / folder
