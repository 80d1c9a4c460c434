"""The contestant's process: no radio, no truth, no network, its own files, bounded resources.

``process`` is the runner's side, ``child`` the contestant's, ``wire`` what they say to each
other. ``landlock``, ``seccomp``, ``namespaces``, ``limits`` and ``bubblewrap`` are the walls;
each says whether the machine has it.
"""
