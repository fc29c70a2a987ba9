"""What was on a line and why: the flight recorder's journal and pages, and captures on disk.

Serves operators who look for a fault. Start with `captures.py`.
"""
