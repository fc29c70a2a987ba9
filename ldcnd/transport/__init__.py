"""Byte pipes to a line: a serial port, a TCP serial server, a simulated line.

Serves the bus. Start with `transport`, the contract; then `serial_port`.
"""
