"""Runs in progress: what another process makes is not made twice."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from mlflow.entities import Run
from mlflow.exceptions import MlflowException

from skin.errors import InputError
from skin.tracking import PROCESS, Store, is_gone

ALIVE = "alive"
"""Tag of a run in progress, which changes every ``BEAT`` seconds."""
BEAT = 60.0
_log = logging.getLogger(__name__)


def refuse_twice(store: Store, fingerprint: str, own: Run | None = None) -> None:
    """Check that no other process makes a run with the same fingerprint.

    A process of another machine lives if it changes its run within two beats; otherwise, the run is called
    KILLED. Of two that begin at the same time, the later one is refused.

    Args:
        store: where.
        fingerprint: of the run.
        own: the run of this process, if it has begun.

    Raises:
        InputError: another process makes it.
    """
    for run in store.find("RUNNING", fingerprint=fingerprint):
        if own is not None and _order(run) >= _order(own):
            continue
        gone = is_gone(run.data.tags.get(PROCESS, ""))
        if gone is None and ALIVE not in run.data.tags:  # made by an earlier version, which gives no signs
            continue
        if gone or (gone is None and _is_silent(store, run)):
            store.client.set_terminated(run.info.run_id, "KILLED")
            continue
        raise InputError(
            f"run {run.info.run_id} with the same configuration is in progress in another process: wait for "
            "it, or train it again with tracking.resume=false"
        )


@contextmanager
def claim(store: Store, run: Run, once: bool) -> Iterator[None]:
    """Change a tag of a run regularly, so that other machines know that its process lives.

    Args:
        store: where.
        run: that this process has begun.
        once: whether to refuse it if another process began the same one earlier.

    Raises:
        InputError: another process did.
    """
    if once:
        refuse_twice(store, run.data.tags["fingerprint"], run)
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(BEAT):
            with suppress(MlflowException):  # a server that is away; the run goes on
                store.client.set_tag(run.info.run_id, ALIVE, str(time.time()))

    store.client.set_tag(run.info.run_id, ALIVE, str(time.time()))
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _is_silent(store: Store, run: Run) -> bool:
    """Return whether a run of another machine gives no sign of life within two beats."""
    identity, sign = run.info.run_id, run.data.tags[ALIVE]
    _log.warning("run %s of another machine may be in progress: waiting %g s for it", identity, 2 * BEAT)
    deadline = time.monotonic() + 2 * BEAT
    while time.monotonic() < deadline:
        time.sleep(BEAT / 12)
        now = store.client.get_run(identity)
        if now.info.status != "RUNNING" or now.data.tags[ALIVE] != sign:
            return False
    return True


def _order(run: Run) -> tuple[int, str]:
    return run.info.start_time, run.info.run_id
