"""Health of a rig as Prometheus metrics.

For those who monitor many rigs, through `ldcnd metrics`. Start with `exposition`.
"""
