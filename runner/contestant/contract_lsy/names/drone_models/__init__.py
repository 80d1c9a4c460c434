"""Stands in for drone_models where it is not installed."""

available_models = ("first_principles", "so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag")
