"""What suits an axis, found from its traces; one package per family, pure functions without I/O."""
