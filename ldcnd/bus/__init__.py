"""One RS-485 line and the one exchange that may be outstanding on it."""
