"""The rules of a flight: the referee, its compiled kernel, and what an episode comes to."""
