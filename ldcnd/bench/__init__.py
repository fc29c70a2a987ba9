"""A drive on the bench: scan, examine, accept, commission, tune, and the measures of its friction.

Start with `family`, what the bench does with drives of a family on a line that no daemon owns.
"""
