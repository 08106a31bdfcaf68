"""Check that arrays fit into memory before they are allocated."""

import psutil

from skin.errors import InputError


def require_memory(needed: float, what: str, mend: str) -> None:
    """Raise InputError unless ``needed`` bytes of memory are available.

    Args:
        needed: estimate, bytes.
        what: subject of the error message.
        mend: end of the error message: what to set instead.

    Raises:
        InputError: the estimate exceeds the available memory.
    """
    available = psutil.virtual_memory().available
    if needed > available:
        raise InputError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory, {available / 1e9:.3g} GB are free: {mend}"
        )
