from __future__ import annotations

import pytest

from tests.sim_backend.physics.bullet_world import LEVEL_GATES, LEVEL_OBSTACLES, BulletWorld


@pytest.fixture
def make_bullet(tmp_path):
    """Builds PyBullet worlds that are closed after the test."""
    pytest.importorskip("pybullet")
    worlds = []

    def make(gates=LEVEL_GATES, obstacles=LEVEL_OBSTACLES, **options) -> BulletWorld:
        worlds.append(BulletWorld(tmp_path, gates, obstacles, **options))
        return worlds[-1]

    yield make
    for world in worlds:
        world.close()
