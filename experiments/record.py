"""Short for `skin record`."""

import sys

from skin.cli import main

if __name__ == "__main__":
    main(["record", *sys.argv[1:]])
