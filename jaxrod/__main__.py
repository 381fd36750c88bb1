"""Entry point of `python -m jaxrod`, the same as `jaxrod`."""

import sys

from jaxrod.cli import main

sys.exit(main())
