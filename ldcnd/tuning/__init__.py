"""Gains for an axis, computed from its traces; one package per family, pure functions without I/O."""
