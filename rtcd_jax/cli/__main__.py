"""`python -m rtcd_jax.cli VERB …`, the same as `rtcd VERB …`."""

import sys

from rtcd_jax.cli.main import main

sys.exit(main())
