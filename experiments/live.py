"""Short for `skin live`."""

import sys

from skin.__main__ import main

if __name__ == "__main__":
    main(["live", *sys.argv[1:]])
