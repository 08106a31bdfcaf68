"""Short for `skin table`."""

import sys

from skin.cli import main

if __name__ == "__main__":
    main(["table", *sys.argv[1:]])
