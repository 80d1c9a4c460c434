"""Names that controllers of lsy_drone_racing import; they resolve in their process alone."""
