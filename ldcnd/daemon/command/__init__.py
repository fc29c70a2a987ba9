"""The way of a command: who may, whether it came before, what became of it, what happens when control is lost.

Serves clients through `process/daemon.py`. Start with `requests.py`: from a query to a reply; then `dispatch.py`.
"""
