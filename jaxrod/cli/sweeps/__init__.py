"""Sweeps of many runs: planning, parallel training here or on a cluster, results."""
