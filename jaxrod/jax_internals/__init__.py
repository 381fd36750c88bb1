"""Internals of JAX without a promise of compatibility, used only through this package.

- `primitives`: jaxrod's own primitives, and their rules in JAX.
- `equations`: names of the parameters of equations.
- `foreign_call`: the binary interface by which XLA calls machine code.
- `mesh_axes`: the part of an array's type that `jax.shard_map` adds.

One more such internal, the test whether JAX has computed yet, is next to its only user
in `jaxrod.installation.backend`.

Nothing here imports `jax.extend`. That would import Pallas, which registers options,
and when a new option appears JAX compiles again everything that was traced before.
`tests/jax_internals` checks each assumption separately, so that a new release of JAX
fails there first. If anything is not as expected, the whole run is left to XLA.
"""
