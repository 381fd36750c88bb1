"""Sensors: differentiable functions from a state to a reading, and their noise."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.sensors.cameras import (
    Camera,
    DepthImage,
    ImageMarkers,
    Markers,
    camera,
    depth_image,
    image_markers,
    markers,
)
from jaxrod.sensors.inertial import (
    Accelerometer,
    Gyroscope,
    accelerometer,
    gyroscope,
)
from jaxrod.sensors.loads import (
    ChamberPressure,
    ContactForce,
    SupportCouple,
    SupportForce,
    TendonLength,
    TendonTension,
    chamber_pressure,
    contact_force,
    support_couple,
    support_force,
    tendon_length,
    tendon_tension,
)
from jaxrod.sensors.noise import noisy
from jaxrod.sensors.sensor import Sensor
from jaxrod.sensors.strain import (
    SectionCurvature,
    SectionForce,
    SectionMoment,
    StrainGauge,
    section_curvature,
    section_force,
    section_moment,
    strain_gauge,
)

__all__ = [
    "Accelerometer",
    "Camera",
    "ChamberPressure",
    "ContactForce",
    "DepthImage",
    "Gyroscope",
    "ImageMarkers",
    "Markers",
    "SectionCurvature",
    "SectionForce",
    "SectionMoment",
    "Sensor",
    "StrainGauge",
    "SupportCouple",
    "SupportForce",
    "TendonLength",
    "TendonTension",
    "accelerometer",
    "camera",
    "chamber_pressure",
    "contact_force",
    "depth_image",
    "gyroscope",
    "image_markers",
    "markers",
    "noisy",
    "section_curvature",
    "section_force",
    "section_moment",
    "strain_gauge",
    "support_couple",
    "support_force",
    "tendon_length",
    "tendon_tension",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
