"""Error messages for a command, or one job of a multirun, that cannot continue."""

import errno
import os
import sqlite3
from collections.abc import Iterator

from hydra.errors import CompactHydraException, HydraException, InstantiationException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from skin.errors import InputError

# Errors of the disk or its permissions; all other system errors are bugs.
_DISK = frozenset(
    (
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EIO,
        errno.EROFS,
        errno.EACCES,
        errno.EPERM,
        errno.ENOTDIR,
    )
)
# What a class raises that gets a setting which it cannot use and whose range it does not declare.
_UNFIT = (ArithmeticError, AttributeError, LookupError, ValueError)


class JobInputError(InputError, CompactHydraException):
    """Bad input of one job of a multirun; Hydra prints its message without a traceback."""


def to_input_error(error: Exception) -> InputError | None:
    """Return an error as an InputError with a message for the user; None for bugs, which need a traceback."""
    if isinstance(error, InputError):
        return error
    for link in _chain(error):
        if isinstance(link, sqlite3.OperationalError) or type(link) is sqlite3.DatabaseError:
            return InputError(
                f"the database of runs failed: {link}: make room, or give another one, as in "
                "tracking.uri=sqlite:////FOLDER/runs.db; what has finished is kept"
            )
        if isinstance(link, OSError) and link.errno in _DISK:
            where = link.filename2 or link.filename or "a file"
            return InputError(
                f"cannot use {where}: {os.strerror(link.errno)}: make room or give another folder, and run "
                "the same command again; what has finished is kept"
            )
    if not isinstance(error, HydraException | OmegaConfBaseException | TypeError):
        return None
    if isinstance(error, OverrideParseException):
        return InputError(f"{error.override} is no override: {one_line(error)}")
    cause = error.__cause__ if isinstance(error, InstantiationException) else None
    if isinstance(cause, InputError):
        return cause
    reason = cause or error
    if isinstance(reason, TypeError) and "argument" not in str(reason):
        return InputError(one_line(error)) if isinstance(error, InstantiationException) else None
    if isinstance(error, InstantiationException) and cause is not None and not isinstance(cause, TypeError):
        return InputError(one_line(error)) if isinstance(cause, _UNFIT) else None
    return InputError(one_line(reason))


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and its causes: libraries wrap errors of the system."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line, without the details that OmegaConf adds."""
    text = str(error).split("Config search path:")[0]
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines_left = [line for line in lines if not line.startswith(("object_type", "reference_type"))]
    ends = [" " if line.endswith((".", ":", ",")) else "; " for line in lines_left[:-1]] + [""]
    return "".join(line + end for line, end in zip(lines_left, ends, strict=True))
