"""Axes as modules of a SECoP node, for NICOS and other clients of SECoP, through `ldcnd secop`.

`link` stands between an axis and a module. `node` has the modules and is the only part that imports frappy-core, which
is under the GPL: whoever installs the extra `secop` combines the two.
"""
