"""One trial: its phases, the control loop, the worlds it flies in, what is checked before."""
