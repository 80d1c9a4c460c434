"""Tournaments: strangers' submissions on all levels in secret worlds, points, and a page."""
