"""Short for `skin evaluate`."""

import sys

from skin.__main__ import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
