"""The installation: the release of JAX, its backend, and a report on both."""
