"""The fault campaign: everything that can go wrong, flown in simulation with the safety on.

Each flight is the arena's own composition in virtual time: simulated cameras, estimator,
forwarding, watchdog, command gate, a radio that delays and loses, and today's firmware on the
far side. A contestant flies a circuit; at a random moment of it one fault sets in.

``run`` flies it, ``flight`` is one flight, ``faults`` lists what goes wrong and ``strikes`` is
how, ``outcome`` and ``report`` tell what became of it. ``udp`` flies it in real time over the
virtual radio.
"""
