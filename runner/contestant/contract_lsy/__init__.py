"""The contract of lsy_drone_racing (2025 and 2026): finding, calling and checking a controller."""
