"""Clock, vehicle link, cameras and what guards them, simulated or real."""
