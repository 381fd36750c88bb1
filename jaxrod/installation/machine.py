"""Facts on which measurements depend: processor, cores, devices, releases."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any


def processor() -> str:
    """Name of the processor, or its architecture if the system gives no name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()


def available_cores() -> int:
    """Number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine_facts(load: float | None) -> dict[str, Any]:
    """Processor, cores, load, devices, XLA's flags and releases, in a form for JSON.

    Args:
        load: Load average before anything was measured; None if there is none.
    """
    import jax

    versions = {"python": platform.python_version()}
    for package in ("jax", "jaxlib", "llvmlite", "numpy", "pyelastica", "mujoco"):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "processor": processor(),
        "cores": available_cores(),
        "load_average_before": load,
        "devices": f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "versions": versions,
    }


def processor_and_versions() -> str:
    """Processor and releases of the packages that are used, as one line of text."""
    facts = machine_facts(None)
    versions = ", ".join(f"{name} {v}" for name, v in facts["versions"].items())
    return f"{facts['processor']}; {versions}"
