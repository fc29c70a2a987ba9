"""Commands that go on after they were accepted: home, track, PWM, analog moves, group moves.

Serves `axis/commands.py` through `axis/procedure.py`. Start with `pwm.py`, the shortest.
"""
