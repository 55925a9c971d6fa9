"""`python -m warp_rigid`: the command line `warp-rigid`."""

import sys

from warp_rigid.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())
