"""What a person is told where a command or one job of a multirun cannot go on."""

from hydra.errors import CompactHydraException, InstantiationException

from skin.errors import InputError

__all__ = ["Refused", "refusal", "sentence"]


class Refused(InputError, CompactHydraException):  # noqa: N818
    """Bad input of one job of a multirun: Hydra ends with its sentence, without a traceback."""


def refusal(error: Exception) -> InputError | None:
    """Return the sentence for a person, or None where the error is ours and deserves its traceback."""
    if isinstance(error, InputError):
        return error
    cause = error.__cause__ if isinstance(error, InstantiationException) else None
    if isinstance(cause, InputError):
        return cause
    reason = cause or error
    if isinstance(reason, TypeError) and "argument" not in str(reason):
        return None
    if isinstance(error, InstantiationException) and cause is not None and not isinstance(cause, TypeError):
        return None
    return InputError(sentence(reason))


def sentence(error: BaseException) -> str:
    """Return what an error says, on one line; OmegaConf adds lines about its own objects."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    kept = [line for line in lines if not line.startswith(("object_type", "reference_type"))]
    return "; ".join(kept)
