"""Checks and settings of the installation: release of JAX, XLA options, devices."""
