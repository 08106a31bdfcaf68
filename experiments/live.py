"""Short for `skin live`."""

import sys

from skin.cli import main

if __name__ == "__main__":
    main(["live", *sys.argv[1:]])
