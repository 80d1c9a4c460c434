"""Points and places."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.runner.tournament.rules import Best, Category, Ties, load_rules, parse_rules
from crazyarena.runner.tournament.scoring import Standings, place, score
from tests.runner.tournament.made_up import line

IROS, LSY = load_rules("iros2022")[0], load_rules("lsy")[0]
A, B = (category.name for category in IROS.categories)


def standings(rules, table: dict[str, dict[str, Sequence[dict[str, Any]]]]) -> Standings:
    """``table``: for each team, by level, fields of its episodes."""
    levels = sorted({level for own in table.values() for level in own})
    episodes = {
        (team, level): [line(team, level, k, **e) for k, e in enumerate(own)]
        for team, by_level in table.items()
        for level, own in by_level.items()
    }
    return score(rules, list(table), levels, episodes, {k: len(v) for k, v in episodes.items()})


def crash(**fields: Any) -> dict[str, Any]:
    return {"clean": False, "completed": False, "collisions": 1, **fields}


Episodes = st.lists(
    st.builds(
        lambda clean, time, learning: {
            "clean": clean,
            "completed": clean,
            "flight_time": time,
            "learning_time": learning,
        },
        st.booleans(),
        # Few values, so that ties happen.
        st.integers(1, 6).map(float),
        st.sampled_from([0.0, 0.25, 0.5]),
    ),
    min_size=3,
    max_size=3,
)
Tables = st.lists(
    st.fixed_dictionaries({"level0": Episodes, "level1": Episodes}), min_size=1, max_size=6
).map(lambda teams: {f"team {k}": own for k, own in enumerate(teams)})
AnyRules = st.sampled_from([IROS, LSY, IROS.model_copy(update={"ties": Ties.SHARED})])


# The paper's table


def ranks_of(counts: Sequence[tuple[int, int, int]]) -> list[tuple[str, ...]]:
    """Ten rankings of three teams in which team k is first, second, third ``counts[k]`` times."""
    found: list[tuple[str, ...]] = []

    def go(left: tuple[tuple[int, ...], ...], chosen: list[tuple[str, ...]]) -> bool:
        if len(chosen) == 10:
            found.extend(chosen)
            return True
        for order in itertools.permutations(range(3)):
            if all(left[team][rank] for rank, team in enumerate(order)):
                rest = tuple(
                    tuple(n - (order[r] == t) for r, n in enumerate(own))
                    for t, own in enumerate(left)
                )
                if go(rest, [*chosen, tuple("abc"[t] for t in order)]):
                    return True
        return False

    assert go(tuple(counts), [])
    return found


def splits(total: int) -> list[tuple[int, int, int]]:
    """Firsts, seconds and thirds of a team with so many points from ten rankings."""
    return [
        (i, j, 10 - i - j)
        for i in range(11)
        for j in range(11 - i)
        if 20 * i + 10 * j + 5 * (10 - i - j) == total
    ]


PUBLISHED = [
    counts
    for counts in itertools.product(splits(150), splits(115), splits(85))
    if all(sum(own[rank] for own in counts) == 10 for rank in range(3))
]


def test_the_published_totals_can_come_from_ranks_at_all():
    assert len(PUBLISHED) > 3


@pytest.mark.parametrize("counts", PUBLISHED)
def test_ranks_of_the_paper_give_the_points_of_the_paper(counts):
    """Five scenarios, two categories each, three teams: 150, 115 and 85 points."""
    rankings = ranks_of(counts)
    table: dict[str, dict[str, list[dict[str, Any]]]] = {team: {} for team in "abc"}
    for scenario in range(5):
        first, second = rankings[2 * scenario], rankings[2 * scenario + 1]
        for team in "abc":
            flight = 10.0 + first.index(team)
            total = 100.0 + second.index(team)
            table[team][f"level{scenario}"] = [
                {"flight_time": flight, "learning_time": total - flight}
            ]
    result = standings(IROS, table)
    assert [result.totals[team] for team in "abc"] == [150.0, 115.0, 85.0]
    assert [result.places[team] for team in "abc"] == [1, 2, 3]


# Rules of 2022


def test_the_last_episode_decides_safety_and_performance():
    table = {
        "late bloomer": {"level0": [crash(), crash(), {"flight_time": 5.0}]},
        "steady": {"level0": [{"flight_time": 6.0}] * 3},
        "unlucky": {"level0": [{"flight_time": 1.0}, {"flight_time": 1.0}, crash()]},
    }
    result = standings(IROS, table)
    rows = result.levels["level0"]
    assert rows["late bloomer"].categories[A].place == 1
    assert rows["steady"].categories[A].points == 10.0
    assert not rows["unlucky"].qualified
    assert result.totals["unlucky"] == 0.0
    # All episodes count for efficiency, also those that went wrong.
    assert rows["late bloomer"].categories[B].value == pytest.approx(8.0 + 8.0 + 5.0)
    assert rows["steady"].categories[B].place == 1


def test_learning_costs_efficiency_and_not_performance():
    table = {
        "thinker": {"level0": [{"flight_time": 5.0, "learning_time": 9.0}] * 2},
        "flyer": {"level0": [{"flight_time": 6.0}] * 2},
    }
    rows = standings(IROS, table).levels["level0"]
    assert rows["thinker"].categories[A].place == 1
    assert rows["thinker"].categories[B].place == 2


def test_a_touch_disqualifies_even_when_the_task_was_completed():
    touched = {"clean": False, "completed": True, "collisions": 1}
    assert not standings(IROS, {"a": {"level0": [touched]}}).levels["level0"]["a"].qualified


def test_who_has_not_flown_everything_does_not_qualify():
    episodes = {("a", "level0"): [line("a", "level0", 0)]}
    result = score(IROS, ["a"], ["level0"], episodes, {("a", "level0"): 2})
    assert result.qualified["a"] == 0
    assert score(IROS, ["a"], ["level0"], {}, {("a", "level0"): 2}).totals["a"] == 0.0


def test_the_fourth_gets_nothing():
    table = {f"team {k}": {"level0": [{"flight_time": 5.0 + k}]} for k in range(5)}
    assert sorted(standings(IROS, table).totals.values()) == [0.0, 0.0, 10.0, 20.0, 40.0]


# The rule of lsy_drone_racing


def test_half_of_the_runs_must_succeed_and_the_mean_time_of_those_counts():
    table = {
        "half": {"level2": [{"flight_time": 5.0}, {"flight_time": 7.0}, crash(), crash()]},
        "less": {"level2": [{"flight_time": 1.0}, crash(), crash(), crash()]},
        "all": {"level2": [{"flight_time": 8.0}] * 4},
    }
    result = standings(LSY, table)
    assert result.order == ["half", "all", "less"]
    assert result.values["half"] == 6.0
    assert result.values["less"] is None


# Whatever the rules


@given(Tables, AnyRules, st.randoms(use_true_random=False))
def test_the_order_of_teams_has_no_part(table, rules, random):
    names = list(table)
    random.shuffle(names)
    one, other = standings(rules, table), standings(rules, {name: table[name] for name in names})
    assert one == other


@given(Tables, AnyRules)
def test_names_have_no_part(table, rules):
    one = standings(rules, table)
    renamed = dict(zip(reversed(list(table)), table.values(), strict=True))
    other = standings(rules, renamed)
    for old, new in zip(table, renamed, strict=True):
        assert one.totals[old] == other.totals[new]
        assert one.places[old] == other.places[new]


@given(Tables, AnyRules)
def test_equal_teams_are_equal(table, rules):
    first = next(iter(table))
    result = standings(rules, {**table, "twin": table[first]})
    assert result.places[first] == result.places["twin"]
    assert result.totals[first] == result.totals["twin"]


@given(Tables, AnyRules)
def test_only_who_qualified_gets_points_and_better_values_never_fewer(table, rules):
    result = standings(rules, table)
    for rows in result.levels.values():
        for category in rules.categories:
            own = [row.categories[category.name] for row in rows.values()]
            known = sorted((p for p in own if p.value is not None), key=lambda p: p.value)
            assert all(a.points >= b.points for a, b in itertools.pairwise(known))
            assert all(a.place <= b.place for a, b in itertools.pairwise(known))
        assert all(row.qualified or row.points == 0.0 for row in rows.values())


@given(st.dictionaries(st.text(min_size=1, max_size=3), st.integers(0, 4).map(float), min_size=1))
def test_shared_points_are_neither_made_nor_lost(values):
    category = Category(name="c", points=(20.0, 10.0, 5.0))
    placed = place(category, values, Ties.SHARED)
    assert sum(p.points for p in placed.values()) == pytest.approx(
        sum((20.0, 10.0, 5.0)[: len(values)])
    )


@given(Tables)
def test_nobody_qualified(table):
    broken = {t: {k: [crash()] * 3 for k in own} for t, own in table.items()}
    for rules in (IROS, LSY):
        result = standings(rules, broken)
        assert set(result.totals.values()) == {0.0}
        assert set(result.places.values()) == {1}
        assert set(result.qualified.values()) == {0}
        assert result.order == sorted(table)


def test_one_team_gets_all_it_can():
    result = standings(IROS, {"alone": {"level0": [{}], "level1": [{}]}})
    assert result.totals == {"alone": 80.0}
    assert result.places == {"alone": 1}


def test_a_chain_of_near_values_ties_only_what_is_equal():
    category = Category(name="c", points=(20.0, 10.0, 5.0))
    values = {"a": 1.0, "b": 1.0 + 0.8e-9, "c": 1.0 + 1.6e-9}
    assert [place(category, values)[t].place for t in "abc"] == [1, 1, 3]


def test_highest_wins_where_the_rules_say_so():
    category = Category(name="c", best=Best.HIGHEST, points=(1.0,))
    assert place(category, {"a": 1.0, "b": 3.0})["b"].points == 1.0


def test_own_rules_with_weights_statistic_and_qualification():
    rules = parse_rules(
        """
name: ours
qualification: {episodes: all, success: completed, rate: 0.5}
categories:
  - {name: speed, statistic: median, points: [3, 1], weight: 2}
  - {name: gates, measure: gates, episodes: all, best: highest, points: [1]}
  - {name: thinking, measure: compute_time, episodes: all, statistic: worst, points: [1]}
"""
    )
    table = {
        "fast": {"x": [{"flight_time": t} for t in (4.0, 5.0, 9.0)]},
        "slow": {"x": [{"flight_time": 6.0, "compute_ms": {"p99": 0.1}}] * 3},
    }
    result = standings(rules, table)
    assert result.levels["x"]["fast"].categories["speed"].value == 5.0
    assert result.totals == {"fast": 2 * 3.0 + 1.0, "slow": 2 * 1.0 + 1.0 + 1.0}
