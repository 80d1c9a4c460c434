"""Drawing into the simulation."""


def draw_line(sim, points, rgba=None, start_size=3.0, end_size=3.0):
    """Draw a line through points (n, 3)."""
    sim.crazyarena_draw("line", points, rgba, start_size)


def draw_points(sim, points, rgba=None, size=0.01):
    """Draw points (n, 3)."""
    sim.crazyarena_draw("points", points, rgba, size)


def draw_capsule(sim, p1, p2, radius=0.01, rgba=None):
    """Draw a capsule as the line between its ends."""
    sim.crazyarena_draw("line", [p1, p2], rgba, radius)
