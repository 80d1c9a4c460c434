"""Pages of the documentation that are made of the code, and a place in the menu for all others.

A hook of MkDocs (``mkdocs.yml``). What the code says of itself is not written a second time.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

# Pages that have their place as soon as they are there: section, title, file.
OPTIONAL = (
    ("How-to", "Hold a tournament", "tournament.md"),
    ("How-to", "Watch flights", "viewer.md"),
)
_SCHEMA_FILES = ("schema", "arena", "track", "randomization", "values", "fields")


def on_config(config: Any) -> Any:
    """Enter the optional pages that exist."""
    for section, title, file in OPTIONAL:
        if (Path(config["docs_dir"]) / file).is_file():
            pages = next(entry[section] for entry in config["nav"] if section in entry)
            if not any(file in page.values() for page in pages):
                pages.append({title: file})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made here."""
    from mkdocs.structure.files import File

    for name, content in generated().items():
        files.append(File.generated(config, name, content=content))
    return files


def generated() -> dict[str, str]:
    """Every page that is made here, by its file name."""
    from crazyarena.runner.records.result_schema import result_schema

    return {
        "reference/cli.md": command_line(),
        "reference/level.md": level_fields(),
        "reference/recording.md": recording(),
        "reference/result.md": result(result_schema()),
        "reference/result.schema.json": json.dumps(result_schema(), indent=2) + "\n",
    }


def command_line() -> str:
    """Every command with its arguments and options, as ``--help`` has them."""
    import typer

    from crazyarena.runner.cli import make_app

    root = typer.main.get_command(make_app())
    lines = ["# Command line", "", "`crazyarena COMMAND --help` says the same.", ""]
    for name, command in sorted(root.commands.items()):  # type: ignore[attr-defined]
        lines += [f"## crazyarena {name}", "", _prose(command.help or ""), ""]
        parameters = [p for p in command.params if not getattr(p, "hidden", False)]
        if not parameters:
            continue
        lines += ["| | | default |", "|---|---|---|"]
        context = typer.Context(command, info_name=name)
        for p in parameters:
            # Click's own record names what is taken; arguments have no flags.
            told = p.get_help_record(context)
            usage = told[0] if told else p.name.upper()
            text = getattr(p, "help", "") or ""
            default = p.default if not callable(p.default) else None
            shown = "" if default in (None, False, (), []) else f"`{_plain(default)}`"
            lines.append(f"| `{_cell(usage)}` | {_cell(text)} | {shown} |")
        lines.append("")
    return "\n".join(lines)


def _plain(value: Any) -> str:
    return str(getattr(value, "value", value))


def _prose(text: str) -> str:
    return re.sub(r"[ \t]+\n", "\n", text.replace("\b", "").strip())


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def level_fields() -> str:
    """Every field of a level file, with type, bounds and default, from its JSON Schema."""
    from crazyarena.levels.schema import Level

    schema = Level.model_json_schema()
    told = _attribute_docs()
    lines = [
        "# Fields of a level file",
        "",
        "Made of the schema that level files are held to; [Levels](../levels.md) explains them.",
        "Units are m, s, rad, kg, N.",
        "",
    ]
    for name, part in [("Level", schema), *sorted(schema["$defs"].items())]:
        if "properties" not in part:
            continue
        heading = "Level" if name == "Level" else name
        lines += [f"## {heading}", "", "| field | type | default | |", "|---|---|---|---|"]
        for field, about in part["properties"].items():
            default = f"`{json.dumps(about['default'])}`" if "default" in about else ""
            if field not in part.get("required", ()) and not default:
                default = "made of its own fields' defaults"
            text = _cell(told.get((name, field), ""))
            lines.append(f"| `{field}` | {_type(about, schema['$defs'])} | {default} | {text} |")
        lines.append("")
    return "\n".join(lines)


def _type(about: dict[str, Any], known: dict[str, Any]) -> str:
    if "$ref" in about:
        name = about["$ref"].rpartition("/")[2]
        if name not in known:
            return "object"
        # What is a choice of words is told here; what has fields has a table.
        return (
            f"[{name}](#{name.lower()})"
            if "properties" in known[name]
            else _type(known[name], known)
        )
    if "anyOf" in about:
        return " or ".join(dict.fromkeys(_type(choice, known) for choice in about["anyOf"]))
    if "enum" in about:
        return ", ".join(f"`{value}`" for value in about["enum"])
    if "const" in about:
        return f"`{about['const']}`"
    kind = about.get("type", "")
    if kind == "array":
        items = about.get("prefixItems") or [about.get("items", {})]
        return f"list of {_type(items[0], known) or 'values'}"
    bounds = {
        "minimum": "≥",
        "exclusiveMinimum": ">",
        "maximum": "≤",
        "exclusiveMaximum": "<",
    }
    limits = [f"{sign} {about[key]:g}" for key, sign in bounds.items() if key in about]
    return " ".join([kind, *limits])


def _attribute_docs() -> dict[tuple[str, str], str]:
    """Texts below the fields of the schema's classes."""
    found = {}
    for name in _SCHEMA_FILES:
        for node in ast.parse((ROOT / "levels" / f"{name}.py").read_text("utf-8")).body:
            if not isinstance(node, ast.ClassDef):
                continue
            for field, text in zip(node.body, node.body[1:], strict=False):
                if (
                    isinstance(field, ast.AnnAssign)
                    and isinstance(field.target, ast.Name)
                    and isinstance(text, ast.Expr)
                    and isinstance(text.value, ast.Constant)
                ):
                    found[node.name, field.target.id] = str(text.value.value)
    return found


def recording() -> str:
    """Topics of a recording, with their message definitions."""
    from crazyarena.runner.records.recorder import CHANNELS, SENT_KINDS, VEHICLE_CHANNEL

    lines = [
        "# Recordings",
        "",
        "One MCAP file an episode (<https://mcap.dev>), uncompressed, with an index. Log time is "
        "that of the episode in ns. The metadata record `crazyarena` says what was flown: level "
        "file, seed, submission's SHA-256, start, gates and obstacles as they truly stood; `verbs` "
        "names the numbers in `/command`. Its entry `crazyarena` is the first version that wrote "
        "recordings like this; which one did is in `result.json`.",
        "",
        "`crazyarena export RUN --csv` or `--npz` makes tables of it. During the flight it is a "
        "`….mcap.part`, which has no index yet and can be read as far as it goes.",
        "",
    ]
    for channel in [*CHANNELS, VEHICLE_CHANNEL]:
        encoding = f"{channel.message_encoding} ({channel.schema_encoding})"
        only = " Arena levels only." if channel is VEHICLE_CHANNEL else ""
        lines += [
            f"## {channel.topic}",
            "",
            f"`{channel.schema_name}`, {encoding}.{only}",
            "",
            "```text",
            channel.schema.strip(),
            "```",
            "",
        ]
    lines += ["## Commands sent", "", ", ".join(f"`{kind.__name__}`" for kind in SENT_KINDS), ""]
    return "\n".join(lines)


def result(schema: dict[str, Any]) -> str:
    """``result.json`` as tables."""
    lines = [
        "# result.json",
        "",
        "Replaced in one piece after every episode, `finished` is false until the last. As JSON "
        "Schema: [result.schema.json](result.schema.json).",
        "",
    ]
    for title, part in (
        ("The document", schema),
        ("An episode", schema["$defs"]["EpisodeResult"]),
    ):
        lines += [f"## {title}", ""]
        if title == "An episode":
            lines += [part["description"], ""]
        lines += ["| field | type | |", "|---|---|---|"]
        for field, about in part["properties"].items():
            lines.append(
                f"| `{field}` | {_type(about, {})} | {_cell(about.get('description', ''))} |"
            )
        lines.append("")
    return "\n".join(lines)
