"""What the daemon asks of a drive, and a folder for each family of drives.

For axes, which drive any axis through it, and for those who add a family. Start with `driver`, then `network`; `known`
lists the families, `line_plan` tells what a line can carry.
"""
