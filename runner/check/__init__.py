"""Looks at a submission before it is handed in: its source, its contract, how it flies."""
