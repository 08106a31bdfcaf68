"""Short for `skin study study=table`."""

import sys

from skin.__main__ import main

if __name__ == "__main__":
    main(["study", "study=table", *sys.argv[1:]])
