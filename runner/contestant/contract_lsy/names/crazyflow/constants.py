"""Constants of the vehicle that the level flies."""

import os

from crazyarena.sim_backend.successor_models import load_params

_PARAMS = load_params("first_principles", os.environ.get("CRAZYARENA_DRONE_MODEL", "cf21B_500"))
GRAVITY = 9.81
MASS = _PARAMS["mass"]
ARM_LEN = _PARAMS["L"]
J = _PARAMS["J"]
J_INV = _PARAMS["J_inv"]
