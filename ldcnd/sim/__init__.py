"""Parts shared by simulated lines of every family: time, bytes, faults, motors."""
