"""Waits for what other threads and processes do."""

from time import monotonic, sleep

PATIENCE = 300  # s, on a machine that is busy with other things


def until(found, process=None, wanted=None):
    """Wait until a function gives ``wanted``, or anything true, and return it; ``process`` must not end."""
    deadline = monotonic() + PATIENCE
    while not (result := found()) if wanted is None else (result := found()) != wanted:
        assert monotonic() < deadline, f"waited in vain: {result}"
        assert process is None or process.poll() is None, "ended while waited for"
        sleep(0.05)
    return result
