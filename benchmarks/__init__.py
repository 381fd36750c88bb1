"""Programs that measure jaxrod, and what they measured; a checkout has them.

A benchmark is a folder with `run.py`, a module with `add_arguments(parser)` and
`run(args)`, as the commands of `jaxrod.cli` are. `python -m benchmarks` lists them,
`python -m benchmarks NAME` runs one. `jaxrod reproduce`, `jaxrod tradeoff` and `jaxrod
benchmark` are `paper`, `tradeoff` and `rod_steps`. The package that is installed does
not hold them and imports nothing from here.
"""
