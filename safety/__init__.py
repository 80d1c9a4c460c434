"""Arena shapes, watchdog, command gate, emergency stop, pre-flight checks."""
