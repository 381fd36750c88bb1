"""Makes the fixtures that call commands known."""

from commands import run as run
from commands import run_json as run_json
