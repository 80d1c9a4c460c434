"""crazyarena: fly drone-racing controllers on real Crazyflies, after dry-running them in sim.

This package holds only what every folder shares: the clock, the errors and the types that
cross borders. The rest lives in the folders of the same name at the top of the repository
(``crazyarena.levels`` is ``levels/``, and so on).
"""

__version__ = "0.2.0"
