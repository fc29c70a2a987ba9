"""Bus budgets, computed from the configuration before any port is opened.

Serves `ldcnd plan`, `check-config` and the daemon's start and reload. Start with `plan.py`.
"""
