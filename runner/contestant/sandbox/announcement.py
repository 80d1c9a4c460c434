"""What a sandbox tells at its beginning."""

from __future__ import annotations

from typing import Any


def announcement(description: dict[str, Any]) -> str:
    """What is in force, for the terminal, of a contestant in a process of its own."""
    walls = ", ".join(description["sandbox"]) or "none"
    missing = description["missing"]
    text = f"Contestant in its own process; sandbox: {walls}"
    return text if not missing else f"{text}. NOT shut off: {', '.join(missing)}"
