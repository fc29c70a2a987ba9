"""The contract between the daemon and the drive families, in values of axes and lines.

For the daemon, which drives any axis through it, and for those who add a family. Start with `driver`, then `network`.
"""
