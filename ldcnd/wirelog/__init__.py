"""The traffic of a line: the record that every line keeps, and captures of it in files.

For people who search for a fault, and for the tests, which replay captures. Start with `recorder`.
"""
