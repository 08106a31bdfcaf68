"""Short for `skin train`."""

import sys

from skin.__main__ import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
