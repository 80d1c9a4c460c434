"""A Crazyflie in software: firmware, physics, and its wire protocol."""
