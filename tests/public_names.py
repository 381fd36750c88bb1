"""Public functions and classes of the core by name, whichever namespace they are in."""

import jaxrod

NAMESPACES = (
    jaxrod,
    jaxrod.actuation,
    jaxrod.fluids,
    jaxrod.materials,
    jaxrod.schedules,
    jaxrod.sensors,
    jaxrod.shapes,
    jaxrod.systems,
    jaxrod.topology,
)
PUBLIC = {name: getattr(space, name) for space in NAMESPACES for name in space.__all__}
