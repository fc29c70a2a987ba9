"""Simulated SmartSteps with time as an input, for tests and for `[[sim]]` lines.

Start with `cable.py` (a line of units), then `unit.py` (packets) and `drive.py` (what is behind them); `variant.py`
lists how a drive may behave where the manual leaves room, `simulation.py` is the configuration.
"""
