"""Short for `skin study study=table`."""

from skin.__main__ import main

if __name__ == "__main__":
    main(before=["study", "study=table"])
