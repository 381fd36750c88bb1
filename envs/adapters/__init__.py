"""Adapters that expose environments to other libraries."""
