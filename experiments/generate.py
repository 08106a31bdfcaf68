"""Short for `skin generate`."""

import sys

from skin.__main__ import main

if __name__ == "__main__":
    main(["generate", *sys.argv[1:]])
