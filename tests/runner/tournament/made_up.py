"""Tournaments nobody has flown: a results folder with made-up episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.runner.tournament.entries import _slug
from crazyarena.runner.tournament.plan import Options, Plan, Team, plan_level, write_plan
from crazyarena.runner.tournament.rules import load_rules
from crazyarena.runner.tournament.run import Tournament, open_tournament

LEVELS = ("level0", "level1", "level2", "level3", "sim2real")


def line(team: str, level: str, draw: int, **fields: Any) -> dict[str, Any]:
    """A line of the journal: a clean flight of 8 s unless the fields say otherwise."""
    return {
        "key": f"{team}/{level}/{draw}",
        "team": team,
        "level": level,
        "draw": draw,
        "block": f"{team}/{level}/0",
        "outcome": "TASK COMPLETION",
        "why": "TASK COMPLETION",
        "clean": True,
        "completed": True,
        "flight_time": 8.0,
        "learning_time": 0.0,
        "gates_passed": 4,
        "gates": 4,
        "collisions": 0,
        "violations": 0,
        "gate_times": [],
        "compute_ms": {"p50": 0.1, "p99": 0.4},
        "noise_ms": {"p50": 0.02, "p99": 0.03, "max": 0.05},
        "missed_ticks": 0,
        "events": [],
        "error": None,
        "path": [],
        "place": None,
        "recording": None,
        "wall": 0.5,
        "worker": {"host": "here", "cpu": "any", "pid": 1, "cores": [0, 1], "pinned": False},
        **fields,
    }


def planned(
    out: Path,
    names: Sequence[str],
    levels: Sequence[str] = ("level0",),
    seeds: int = 3,
    rules: str = "iros2022",
) -> Tournament:
    """A tournament in which nothing has flown, of teams without submissions."""
    rule_set, text = load_rules(rules)
    taken = set[str]()
    plan = Plan(
        tuple(
            Team(name, _slug(name, taken), f"submissions/{name}", "iros2022",
                 archive="0" * 64, place=name)
            for name in names
        ),
        tuple(plan_level(level, range(seeds), rule_set.controller) for level in levels),
        Options(seeds=seeds),
        text,
        "Made up",
        "2026-01-01T00:00:00+00:00",
    )  # fmt: skip
    out.mkdir(exist_ok=True)
    write_plan(plan, out)
    return open_tournament(out, None)


def flown(
    out: Path, teams: int = 40, levels: Sequence[str] = LEVELS, seeds: int = 10
) -> Tournament:
    """Teams of all strengths, with paths, failures and recordings that are there."""
    rng = np.random.default_rng(1)
    words = ("Falcon", "Swift", "Kestrel", "Merlin", "Osprey", "Hobby", "Martin", "Plover")
    names = [f"{words[k % 8]} {k // 8 + 1}" for k in range(teams)]
    tournament = planned(out, names, levels, seeds)
    lines = []
    for index, team in enumerate(tournament.plan.teams):
        skill = 1.0 - index / teams
        (out / "recordings" / team.slug).mkdir(parents=True)
        for number, level in enumerate(levels):
            for draw in range(seeds):
                path = _path(rng)
                good = rng.random() < skill**0.5 - 0.08 * number
                fields: dict[str, Any] = {"path": path, "place": [*path[-1]]}
                fields["recording"] = f"recordings/{team.slug}/{level}-{draw:04d}.mcap"
                (out / fields["recording"]).write_bytes(b"no recording")
                fields["flight_time"] = round(7.0 + 4.0 * (1 - skill) + rng.normal(0.0, 0.3), 3)
                fields["learning_time"] = round(float(rng.random()) * 0.2, 4)
                if not good:
                    gate = int(rng.integers(0, 4))
                    cut = path[: len(path) * (gate + 1) // 5]
                    fields |= {
                        "clean": False, "completed": False, "collisions": 1, "path": cut,
                        "place": cut[-1], "gates_passed": gate, "outcome": "COLLISION",
                        "why": f"COLLISION with gate {gate} (left bar) at 3.11 s, 0.21 m left",
                        "error": "Traceback <b>markup & more</b>\nValueError: no path",
                    }  # fmt: skip
                lines.append(line(team.slug, level, draw, **fields))
    tournament.journal.append(lines)
    return tournament


def _path(rng: np.random.Generator) -> list[list[float]]:
    knots = np.array(
        [[-0.9, -2.9], [0.5, -2.5], [1.6, -2.2], [2.0, -1.5], [1.5, -0.2], [0.0, 0.2],
         [-0.6, 0.6], [-0.5, 1.5], [-0.5, 2.9]]
    )  # fmt: skip
    t = np.linspace(0, len(knots) - 1, 50)
    index = np.arange(len(knots))
    xy = np.column_stack([np.interp(t, index, knots[:, k]) for k in (0, 1)])
    phase = rng.random() * math.tau
    xy[1:] += 0.08 * np.column_stack([np.sin(t + phase), np.cos(1.3 * t + phase)])[1:]
    return [[round(float(x), 2), round(float(y), 2), 1.0] for x, y in xy]
