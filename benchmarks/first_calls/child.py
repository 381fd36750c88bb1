"""One program in a process of its own; `run.py` starts it with the name of one.

Prints a line of JSON with processor times and what was compiled.
"""

from __future__ import annotations

import json
import sys
import time

PARTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}
"""Events of JAX; tracing and lowering include the kernels made meanwhile."""


def main(name: str) -> None:
    """Measures one program."""
    import jax
    import jax.monitoring

    import jaxrod
    import jaxrod.envs
    from benchmarks.first_calls import programs

    imported = time.process_time()
    seconds: dict[str, float] = dict.fromkeys(PARTS.values(), 0.0)
    counts = dict.fromkeys(PARTS.values(), 0)

    def heard(event: str, duration: float, **more: object) -> None:
        if event in PARTS:
            seconds[PARTS[event]] += duration
            counts[PARTS[event]] += 1

    jaxrod.configure_cpu()
    jax.monitoring.register_event_duration_secs_listener(heard)
    call = getattr(programs, name)()
    begun, before, known = time.process_time(), dict(counts), dict(seconds)
    jax.block_until_ready(call())
    ended, after = time.process_time(), dict(counts)
    made = {part: seconds[part] - known[part] for part in known}
    jax.block_until_ready(call())
    again = time.process_time()
    kernels = [choice for choice in jaxrod.lane_choices() if choice.taken]
    record = {
        "import": imported,
        "prepare": begun - imported,
        "call": ended - begun,
        "again": again - ended,
        "programs": after["compile"] - before["compile"],
        "prepared": before["compile"],
        "kernels": len(kernels),
        "kernels_s": sum(choice.seconds for choice in kernels),
        "left to XLA": len(jaxrod.lane_choices()) - len(kernels),
        **made,
    }
    print(json.dumps(record))


if __name__ == "__main__":
    main(sys.argv[1])
