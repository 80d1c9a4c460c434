"""Parts of the firmware that scripts may call."""
