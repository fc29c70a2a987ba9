"""The rig in a browser: a Zenoh client in a process of its own that serves pages.

For operators, through `ldcnd console`. Start with `server`; `pages` has what one open page holds, `feed` what it sees.
"""
