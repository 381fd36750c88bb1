"""Internals of JAX without a promise of compatibility, used only through this package.

- `primitives`: custom primitives, and their rules in JAX.
- `equations`: parameters of the equations of jaxprs.
- `foreign_call`: the binary interface by which XLA calls machine code.
- `mesh_axes`: the part of an array's type that `jax.shard_map` adds.
- `scans`: scans that may have zero steps.

One more such internal, the test whether JAX has computed yet, is next to its only user
in `jaxrod.installation.backend`.

Nothing here imports `jax.extend`. That would import Pallas, which registers options,
and when a new option appears JAX compiles again everything that was traced before.
`tests/jax_internals` checks each assumption separately, so that a new release of JAX
fails there first. If an assumption fails, the whole run is left to XLA.
"""
