"""``python -m caper_jax``: the same as the ``caper`` command."""

import sys

from caper_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
