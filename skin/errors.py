"""The exception for bad input; its message says what to change."""


class InputError(ValueError):
    """Bad input from a person: a configuration, a file, a layout.

    The message says what was given, what is needed and, where there is one, the override that
    fixes it. The command line prints it without a traceback and exits with code 2.
    """
