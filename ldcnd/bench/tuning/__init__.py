"""Gains for an axis, computed from its traces; one package per family.

For those who tune an axis. Start with the package of its family: a model of the plant, and gains for it.
"""
