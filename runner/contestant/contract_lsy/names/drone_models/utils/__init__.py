"""Helpers of drone_models."""
