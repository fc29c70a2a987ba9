"""A drive family that this folder adds alone: the drives and what simulates them; nothing else has to know it."""
