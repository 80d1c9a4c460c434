"""Why no class is found in a file: it cannot be read as Python."""

from __future__ import annotations

import ast
from pathlib import Path

from crazyarena.bounded_read import check_code
from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line


def no_python(path: Path) -> str:
    """About the first mistake of ``path``, or of a folder's files, that hides its classes.

    Empty where all is Python; begins with a full stop otherwise, to be put behind another.
    """
    for file in sorted(path.glob("*.py")) if path.is_dir() else [path]:
        try:
            check_code(file)
            ast.parse(file.read_bytes(), filename=str(file))
        except SyntaxError as error:
            where = f", line {error.lineno}" if error.lineno else ""
            return f". {shown_line(file.name)}{where} is not valid Python: {shown_line(error.msg)}"
        except (OSError, ValueError, InputError):
            continue
    return ""
