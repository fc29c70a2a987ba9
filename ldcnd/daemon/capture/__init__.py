"""Captures of a line and their causes: the flight recorder's journal and pages, and captures on disk.

Serves operators who search for a fault. Start with `captures.py`.
"""
