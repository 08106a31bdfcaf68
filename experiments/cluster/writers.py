"""Check that several processes can log to a server at the same time.

    python -m experiments.cluster.writers http://127.0.0.1:5000 --seconds 600

Each process begins runs, logs metrics, tags and a file as a training does, and ends them. Afterwards, the
values are read back.
"""

import argparse
import sys
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from multiprocessing.queues import Queue

from skin.runs.configuration import Tracking
from skin.runs.store import Store

EXPERIMENT = "writers"
STEPS = 20


def main() -> None:
    """Run the writers; exit code 1 if one of them met an error or a value is missing."""
    parser = argparse.ArgumentParser()
    parser.add_argument("uri")
    parser.add_argument("--writers", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=600)
    given = parser.parse_args()
    context = get_context("fork")
    results: Queue = context.Queue()
    settings = Tracking(given.uri, None, EXPERIMENT, True, None)
    store = Store.open(settings)  # imports, once for all writers
    began = time.monotonic()
    writers = [
        context.Process(target=write, args=(settings, number, began + given.seconds, results))
        for number in range(given.writers)
    ]
    for writer in writers:
        writer.start()
    reports = [results.get() for _ in writers]
    for writer in writers:
        writer.join()
    runs = [run for made, _ in reports for run in made]
    errors = [error for _, error in reports if error]
    with ThreadPoolExecutor(4) as pool:
        lost = sum(pool.map(lambda run: is_incomplete(store, run), runs))
    seconds = time.monotonic() - began
    print(
        f"{len(writers)} writers, {seconds:.0f} s, {len(runs)} runs, {STEPS * len(runs)} batches of metrics"
    )
    print(f"{len(errors)} errors, {lost} incomplete runs", *errors, sep="\n")
    sys.exit(1 if errors or lost or not runs else 0)


def write(settings: Tracking, number: int, end: float, results: Queue) -> None:
    """Log runs until a time of the monotonic clock; put the ids of complete ones and an error, or None."""
    made: list[str] = []
    error = None
    try:
        store = Store.open(settings)
        while time.monotonic() < end:
            with store.run(f"writer {number}", {"writer": str(number)}) as run:
                for step in range(STEPS):
                    store.log_metrics(run, {f"metric_{index}": step + 0.1 * index for index in range(10)})
                    store.client.set_tag(run.info.run_id, "step", str(step))
                store.client.log_text(run.info.run_id, "written", "note.txt")
            made.append(run.info.run_id)
    except Exception:
        error = traceback.format_exc()
    results.put((made, error))


def is_incomplete(store: Store, run: str) -> bool:
    """Return whether a value of a run is missing on the server."""
    found = store.client.get_run(run)
    return (
        found.info.status != "FINISHED"
        or found.data.tags["step"] != str(STEPS - 1)
        or len(store.client.get_metric_history(run, "metric_9")) != STEPS
        or [one.path for one in store.client.list_artifacts(run)] != ["note.txt"]
    )


if __name__ == "__main__":
    main()
