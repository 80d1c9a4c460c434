"""Parameters of vehicles."""

from crazyarena.sim_backend import successor_models


def load_params(physics, drone_model, xp=None):
    """Return the parameters of a vehicle for a kind of dynamics, as a dictionary."""
    params = successor_models.load_params(physics, drone_model)
    if xp is None:
        return params
    return {name: xp.asarray(value) for name, value in params.items()}
