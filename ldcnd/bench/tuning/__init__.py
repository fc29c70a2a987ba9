"""Model of an axis from its traces, gains for it, and the session that takes the traces and tries the gains.

For `ldcnd tune`. Start with `plant.py`. `identify.py` finds a plant in traces of moves, `design.py` proposes gains for
it, `response.py` predicts a move, `excitation.py` says which moves, `verdict.py` compares: pure functions without I/O.
The control law is that of the simulated drive, so there is only one. `session.py` stands on the client.
"""
