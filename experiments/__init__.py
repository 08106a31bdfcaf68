"""What this project runs with the package ``skin``: comparisons, checks of the mechanics, benchmarks."""

import sys
from collections.abc import Callable, Mapping, Sequence

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


def script_settings(words: Sequence[str], defaults: Mapping[str, str]) -> dict[str, str]:
    """Return all settings from words ``name=value``.

    Raises:
        InputError: an unknown name, or a missing value.
    """
    settings = dict(defaults)
    for word in words:
        name, _, value = word.partition("=")
        if name not in settings or not value:
            raise InputError(f"{word} is no setting: give some of {', '.join(f'{key}=' for key in settings)}")
        settings[name] = value
    return settings
