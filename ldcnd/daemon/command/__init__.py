"""The way of a command: who may, whether it came before, what became of it, what happens when control is lost.

Serves clients through `process/daemon.py`. Start with `dispatch.py`: from a query to its reply.
"""
