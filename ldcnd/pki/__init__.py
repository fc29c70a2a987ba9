"""Certificates and roles of a site: a small authority of its own, and the access rules that follow from the roles."""
