"""`python -m jaxrod` is `jaxrod`."""

import sys

from jaxrod.cli import main

sys.exit(main())
