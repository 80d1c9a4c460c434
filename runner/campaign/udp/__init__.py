"""The fault campaign in real time, over the virtual radio.

``run`` flies it; of each flight ``field`` is the far side and ``station`` the ground station, both
processes of their own.
"""
