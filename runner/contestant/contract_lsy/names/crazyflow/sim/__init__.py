"""The simulation as far as controllers see it: something to draw into."""


class Sim:
    """What ``render_callback`` is given; keeps what is drawn, for the recording."""

    max_visual_geom = 1000
    viewer = None

    def __init__(self):
        self.drawn = []

    def crazyarena_draw(self, kind, points, rgba=None, size=1.0):
        """Keep points (n, 3), m, world."""
        self.drawn.append((kind, points, rgba, size))


__all__ = ["Sim"]
