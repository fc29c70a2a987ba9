"""Certificates and roles for a network with mutual TLS, and the access rules that Zenoh enforces for them.

For those who install a rig on a shared network, through `ldcnd pki`. Start with `site`.
"""
