"""Derivatives through time of named scenes: errors, cost, memory."""
