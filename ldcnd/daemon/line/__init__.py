"""Lines at work and the rig that they form: bring-up, polling, drives that return, I/O modules.

Serves `command`, `publish` and `capture`. Start with `line.py`.
"""
