"""Level files: their schema, the shipped levels, the random draws."""
