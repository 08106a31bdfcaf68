"""Refuse what does not fit into memory before it is allocated."""

import psutil

from skin.errors import InputError


def require_memory(needed: float, what: str, mend: str) -> None:
    """Raise unless ``needed`` bytes are free on this machine.

    Args:
        needed: estimate, bytes.
        what: what needs it, the subject of the sentence.
        mend: what to give instead.

    Raises:
        InputError: the estimate passes what is available.
    """
    available = psutil.virtual_memory().available
    if needed > available:
        raise InputError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory, {available / 1e9:.3g} GB are free: {mend}"
        )
