"""Ticks on time: the scheduler, what keeps a thread awake, and how lateness is measured."""
