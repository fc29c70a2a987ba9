"""The `ldcnd` command: one module per noun, and what they share.

For people at a terminal and for scripts. Start with `main`, then `axis`; `sending` sends the commands, `output` prints.
The commands of a wing are in its folder.
"""
