"""Short for `skin generate`."""

import sys

from skin.cli import main

if __name__ == "__main__":
    main(["generate", *sys.argv[1:]])
