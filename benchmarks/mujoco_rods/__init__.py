"""Cables and a cantilever in jaxrod, MuJoCo 4's flex rods and PyElastica."""
