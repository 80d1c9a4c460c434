"""Rigid bodies, motors, contacts, and the engines that put them together."""
