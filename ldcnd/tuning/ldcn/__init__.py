"""What an axis is, from its traces, and which gains suit it: pure functions without I/O.

Start with `plant.py`. `identify.py` finds a plant in traces of moves, `design.py` proposes gains for it, `response.py`
tells what a move will look like. The control law is that of the simulated drive, so there is one of it.
"""
