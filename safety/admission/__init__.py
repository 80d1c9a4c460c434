"""What the command gate lets pass: checks of every kind of command, one module per kind."""
