"""`python -m rtcd_jax.certificate.check FILE`."""

import sys

from rtcd_jax.certificate.check.command import main

sys.exit(main(sys.argv[1:]))
