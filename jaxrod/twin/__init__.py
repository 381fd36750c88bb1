"""Digital twins of real arms, calibrated from a drawing and recordings of markers."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.twin.arm import UNKNOWNS, Arm, Frame, Marker, TendonDrawing, read_arm
from jaxrod.twin.identification import Comparison, Twin, identify
from jaxrod.twin.named_arms import disk_robot, fly_rod, tentacle
from jaxrod.twin.recordings import Recording, read_recording
from jaxrod.twin.registration import Registration, register

__all__ = [
    "UNKNOWNS",
    "Arm",
    "Comparison",
    "Frame",
    "Marker",
    "Recording",
    "Registration",
    "TendonDrawing",
    "Twin",
    "disk_robot",
    "fly_rod",
    "identify",
    "read_arm",
    "read_recording",
    "register",
    "tentacle",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
