"""What was on a line: the record that every line keeps, and captures of it in files.

For people who look for a fault, and for the tests, which play captures back. Start with `recorder`.
"""
