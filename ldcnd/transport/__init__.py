"""Byte pipes to a line: a serial port, a TCP serial server, a simulated line."""
