"""What a SmartStep says of its own tuning, gains that are tried in its RAM, and moves that its recorder compares.

For `ldcnd tune`. The drive identifies its load itself and is moved by pulses from elsewhere, so nothing here moves it.
Start with `session`.
"""
