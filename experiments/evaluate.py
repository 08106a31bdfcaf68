"""Short for `skin evaluate`."""

import sys

from skin.cli import main

if __name__ == "__main__":
    main(["evaluate", *sys.argv[1:]])
