"""LDCN (Logosol) and NMC (J R Kerr): one binary protocol, dialects chosen by profile.

Start with `packet` and `commands`, the protocol; then `network` (a line) and
`servo` (one drive).
"""
