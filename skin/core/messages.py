"""Messages of a command: errors in one sentence, durations, and the silence of libraries."""

import errno
import logging
import os
import re
import sqlite3
import warnings

from hydra.errors import CompactHydraException, HydraException, InstantiationException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from skin.errors import InputError

PARENT = "SKIN_PARENT_RUN"
"""Environment variable with the id of the parent run, by which a sweep makes its jobs quiet."""

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
    link: BaseException | None = error
    while link is not None:  # libraries wrap errors of the system
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
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)
    if isinstance(error, OverrideParseException):
        return InputError(
            f"{error.override} cannot be read as an override, quote its value, as in 'out=\"a (1).csv\"': "
            f"{one_line(error)}"
        )
    if isinstance(error, InstantiationException):
        cause = error.__cause__
        if isinstance(cause, InputError):
            return cause
        if isinstance(cause, TypeError) and _is_argument(cause):
            return InputError(one_line(cause))
        refused = cause is None or isinstance(cause, (*_UNFIT, TypeError))
    else:
        refused = isinstance(error, HydraException | OmegaConfBaseException) or _is_argument(error)
    return InputError(one_line(error)) if refused else None


def _is_argument(error: Exception) -> bool:
    """Return whether an error is about an argument, or about words of Hydra such as ``_partial_``."""
    text = str(error)
    return isinstance(error, TypeError) and ("argument" in text or text.startswith("Instantiation:"))


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line, without the details that OmegaConf adds."""
    text = str(error).split("Config search path:")[0]
    lines = [line.strip() for line in text.splitlines()]
    kept = [line for line in lines if line and not line.startswith(("object_type", "reference_type"))]
    # A line that ends a sentence, or announces the next line, needs no semicolon.
    return re.sub(r"(?<=[.:,]);", "", "; ".join(kept))


# Silence library messages that a user of the command line cannot act on.


_LEVELS = {
    "lightning_fabric": logging.ERROR,
    "pytorch_lightning": logging.ERROR,
    "pytorch_lightning.utilities.rank_zero": logging.ERROR,
    "alembic": logging.WARNING,
    "mlflow": logging.WARNING,
    "urllib3.connectionpool": logging.ERROR,  # else a line for each repeated request to a tracking server
}


def quiet() -> None:
    """Silence remarks of libraries on hardware, logging and their own internals."""
    for name, level in _LEVELS.items():
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.setLevel(level)
    # One task needs no srun.
    for text in ("treespec", "does not have many workers", "`srun` command is available"):
        warnings.filterwarnings("ignore", message=f".*{text}")
