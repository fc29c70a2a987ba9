"""A drive on the bench: scan, accept, commission, tune, and the measures of its friction."""
