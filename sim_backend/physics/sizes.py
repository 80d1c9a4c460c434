"""Sizes of the competition's gates, obstacles and vehicle; apart from the kernels, which take a
while to load."""

from __future__ import annotations

# Competition assets, m.
TALL, LOW = 0, 1  # gate types
GATE_CENTRE_Z = (1.0, 0.525)  # by type
BEAM_WIDTH = 0.05
BEAM_LENGTH = 0.5
BEAM_OFFSET = 0.225  # centre of the gate to the centre line of a beam
POST_RADIUS = 0.05
POST_LENGTH = 0.8
POST_DROP = 0.6  # centre of a tall gate to the centre of its post
BASE_WIDTH = 0.15
BASE_HEIGHT = 0.25
BASE_DROP = 0.4  # centre of a low gate, or of an obstacle, to the centre of its base box
OBSTACLE_CENTRE_Z = 0.525
OBSTACLE_RADIUS = 0.05
OBSTACLE_LENGTH = 0.8

VEHICLE_RADIUS = 0.06
VEHICLE_HALF_LENGTH = 0.0125
