"""Short for `skin record`."""

import sys

from skin.__main__ import main

if __name__ == "__main__":
    main(["record", *sys.argv[1:]])
