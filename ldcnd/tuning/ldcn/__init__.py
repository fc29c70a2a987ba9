"""Model of an axis from its traces, and gains for it: pure functions without I/O.

For `ldcnd tune`. Start with `plant.py`. `identify.py` finds a plant in traces of moves, `design.py` proposes gains for
it, `response.py` predicts a move. The control law is that of the simulated drive, so there is only one.
"""
