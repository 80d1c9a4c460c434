"""What a failed import of a stranger's code lacks, also where the code hid it.

``try: import plan`` / ``except ImportError: from . import plan`` fails with the second import,
whatever was wrong within ``plan``; the first error stands behind it as its context.
"""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Collection, Iterator

from crazyarena.plain_text import shown, shown_line

_MOST_LINKS = 16
_DISTRIBUTIONS = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "stable_baselines3": "stable-baselines3",
    "yaml": "PyYAML",
}
"""What pip calls packages that are imported by another name."""
_BY_HAND = {
    "acados_template": "acados_template is no package of pip's: build acados, install its "
    "interfaces/acados_template with pip, and set ACADOS_SOURCE_DIR to its folder",
    "torch": "torch without GPU support is enough",
}
"""What more there is to say."""


def chain(error: BaseException) -> Iterator[BaseException]:
    """Yield ``error`` and what stands behind it, latest first, as Python's tracebacks do."""
    seen: set[int] = set()
    link: BaseException | None = error
    while link is not None and id(link) not in seen and len(seen) < _MOST_LINKS:
        seen.add(id(link))
        yield link
        hidden = link.__suppress_context__
        link = link.__cause__ or (None if hidden else link.__context__)


def missing(error: BaseException, own: Collection[str] = ()) -> str:
    """Say which packages are not installed, and what to do; empty where none is missing.

    Only where ``error`` is an ImportError, and its like behind it. ``own``: top-level names that
    are no packages to install.
    """
    names: dict[str, None] = {}  # a set that keeps its order
    for link in chain(error):
        if not isinstance(link, ImportError):
            break
        if isinstance(link, ModuleNotFoundError) and isinstance(link.name, str):
            name = link.name.partition(".")[0]
            if name and name not in own and not _is_there(name):
                names[shown_line(name)] = None
    if not names:
        return _own_module(error, own)
    listed = ", ".join(f"'{_DISTRIBUTIONS.get(name, name)}'" for name in reversed(names))
    many = len(names) > 1
    hints = "".join(f". {_BY_HAND[name]}" for name in reversed(names) if name in _BY_HAND)
    return (
        f"; not installed: the package{'s' if many else ''} {listed}. Install "
        f"{'what is needed of them' if many else 'it'} where crazyarena is installed (python -m "
        f"pip install ...), or pass a folder that holds {'them' if many else 'it'}{hints}"
    )


def _own_module(error: BaseException, own: Collection[str]) -> str:
    """What it means if a name is missing in a module that came along."""
    if type(error) is not ImportError or not isinstance(error.name, str):
        return ""
    name = error.name.partition(".")[0]
    if name not in own:
        return ""
    if "partially initialized" in str(error) or _names_its_importer(error):
        return (
            f"; '{shown_line(name)}' is a module of the submission, and was still being imported "
            "itself: it and another one import each other. Move what both need into a third"
        )
    return f"; '{shown_line(name)}' is a module of the submission, which has no such name"


def _names_its_importer(error: ImportError) -> bool:
    """Whether the module that lacks a name is one of those whose import has led there."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    return error.path is not None and error.path in files[:-1]


def told(error: BaseException, ours: str, but: str, limit: int) -> str:
    """Traceback of ``error`` and of what stands behind it, that first, fit to be shown.

    Without frames of the import system and of files under ``ours``, but with those under ``but``;
    of more than ``limit`` characters the end.
    """
    parts = []
    for link in chain(error):
        frames = [
            frame
            for frame in traceback.extract_tb(link.__traceback__)
            if not frame.filename.startswith("<frozen importlib")
            and (not frame.filename.startswith(ours) or frame.filename.startswith(but))
        ]
        lines = ["Traceback (most recent call last):\n", *traceback.format_list(frames)]
        lines += traceback.format_exception_only(type(link), link)
        parts.append("".join(lines).rstrip())
    between = "\n\nThis was followed by:\n\n"
    return shown(between.join(reversed(parts)), limit).rstrip()


def _is_there(name: str) -> bool:
    if name in sys.modules or name in sys.stdlib_module_names:
        return True
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False
