"""Parts of JAX for which it promises no compatibility, used from here alone.

- `primitives`: operations of jaxrod's own, and the rules that JAX keeps for them.
- `equations`: the names of the parameters of equations.
- `foreign_call`: the binary interface by which XLA calls machine code.
- `mesh_axes`: the part of an array's type that `jax.shard_map` adds.

One more such fact, whether JAX has computed yet, stands beside its only user in
`jaxrod.installation.backend`.

Nothing here imports `jax.extend`: that would import Pallas, which registers options,
and JAX compiles everything traced before once more when an option appears.
`tests/jax_internals` checks each fact by itself, so that a new release of JAX fails
there first. Whatever is not as expected leaves the whole run to XLA.
"""
