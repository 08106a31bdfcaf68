"""The one error that means: the input is wrong, and this sentence says how to mend it."""

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input from a person: a configuration, a file, a layout.

    The message says what was given, what is needed and, where there is one, the override that
    mends it. The command line prints it without a traceback and exits with code 2.
    """
