"""Short for `skin generate`."""

from skin.__main__ import main

if __name__ == "__main__":
    main(before=["generate"])
