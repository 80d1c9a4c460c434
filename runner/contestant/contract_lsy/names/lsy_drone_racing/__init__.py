"""Stands in for lsy_drone_racing where its controllers are loaded."""
