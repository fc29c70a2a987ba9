"""One axis: its commands, its state, its telemetry.

Serves `command` and `line`. Start with `axis.py`: a command in its turn, a stop before all turns; then `commands.py`.
"""
