"""Motion capture: pose sources, tracking, estimation, forwarding to the vehicles."""
