"""Simulated LDCN/NMC modules: what their firmware does with packets, and the motors behind it.

For tests, for `ldcnd sim` and for rigs with `port = "sim:NAME"`. Start with chain.py, which builds the modules of
a line; module.py has what every module does with a packet.
"""
