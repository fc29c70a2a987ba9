"""Captures of a line on disk, and their causes.

Serves operators who search for a fault. Start with `captures.py`.
"""
