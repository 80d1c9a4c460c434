"""Settings of the whole suite."""

from hypothesis import settings

# The first call of a compiled kernel compiles it, so no example may be held to a deadline.
settings.register_profile("crazyarena", deadline=None)
settings.load_profile("crazyarena")
