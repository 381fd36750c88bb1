"""Programs that measure jaxrod, and what they measured; a checkout has them.

`jaxrod reproduce`, `jaxrod tradeoff` and `jaxrod benchmark` run `benchmarks.paper`,
`benchmarks.tradeoff` and `benchmarks.rod_steps`. The package that is installed does not
hold them and imports nothing from here.
"""
