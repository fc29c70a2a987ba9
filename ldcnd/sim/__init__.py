"""What simulated lines of every family share: time, bytes, faults, motors."""
