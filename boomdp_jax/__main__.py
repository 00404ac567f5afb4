"""`python -m boomdp_jax`: the command line."""

import sys

from boomdp_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
