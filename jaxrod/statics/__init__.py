"""Equilibria, and the linear systems behind them and behind implicit steps."""
