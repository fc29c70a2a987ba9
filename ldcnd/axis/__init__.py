"""One axis: its commands, its state, its telemetry, its traces.

For the daemon. Start with `axis.py`: a command in its turn, a stop before all turns; then `commands.py`.
"""
