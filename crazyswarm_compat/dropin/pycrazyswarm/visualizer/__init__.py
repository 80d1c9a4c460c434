"""Viewers, one module each."""
