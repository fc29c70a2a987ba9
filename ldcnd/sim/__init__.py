"""Parts shared by simulated lines of every family: time, bytes, faults, motors.

For tests, for `ldcnd sim` and for rigs with `port = "sim:NAME"`. Start with `chain`, the modules of a line; `plant` is
a motor with its load; `known` lists the families that can be simulated.
"""
