"""Sweeps of many runs: plan, parallel training on one machine or a cluster, results."""
