"""Health of a rig as Prometheus metrics."""
