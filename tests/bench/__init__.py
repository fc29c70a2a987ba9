"""What the daemon costs, measured against a floor in the same run: `python -m tests.bench`."""
