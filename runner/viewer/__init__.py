"""Flights in a browser: recorded ones with a time line, live ones as they fly, and the operator's
page. The viewer is a process of its own (``python -m crazyarena.runner.viewer``)."""
