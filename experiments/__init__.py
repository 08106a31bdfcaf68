"""What this project runs with the package ``skin``: comparisons, checks of the mechanics, benchmarks."""

import sys
from collections.abc import Callable

from skin.errors import InputError


def run_script(main: Callable[[list[str]], bool | None]) -> None:
    """Run a script with the words of its command line.

    The exit code is 1 if it returns False, and 2 if the input is bad.
    """
    try:
        sys.exit(main(sys.argv[1:]) is False)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
