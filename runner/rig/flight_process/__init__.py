"""The vehicle's side of a trial in wall time, in a process of its own.

Link, pose source, pipeline, forwarder, command gate, watchdog and emergency stop live there, so
that the control loop has its interpreter to itself, and so that whatever happens to the runner
the vehicle is still watched.
"""
