"""The daemon as a process: built from a configuration, started, reloaded, ended; a capture played back.

Serves `ldcnd run` and `ldcnd replay`. Start with `assembly.py`, then `daemon.py`.
"""
