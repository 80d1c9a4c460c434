"""What a flight script sees: commands, the backend protocol and the Crazyswarm API."""
