"""A drive family that is added by this folder alone: to see that nothing else has to know it."""
