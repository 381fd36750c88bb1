"""Environments as other libraries know them."""
