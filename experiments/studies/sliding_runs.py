"""Finished runs, each evaluated on streams once."""

import hashlib
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from skin.build import build_data, build_device, build_learner
from skin.config import fingerprint
from skin.errors import InputError
from skin.evaluation.course import Course
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.sliding import slide
from skin.reload import TAG, changed, configuration, operating_point, restore
from skin.tracking import Store
from studies.sliding import line, publish

__all__ = ["newest", "try_run"]

_OWN = ("stream", "rows", "out", "run")


def newest(store: Store, simulator: str, rows: str | Sequence[str]) -> list[Run]:
    """Return the newest finished runs of each row on a simulator's data: on whole touches, and on streams.

    Args:
        store: where runs are.
        simulator: as their tag has it.
        rows: names; ``all`` takes every row that has a run.

    Raises:
        InputError: there is none, or a row that is named has none.
    """
    found: dict[tuple[str, bool], Run] = {}
    for run in store.find("FINISHED", simulator=simulator):
        if "learned" in run.data.tags:
            found.setdefault((run.data.tags["row"], run.data.params.get("stream") == "True"), run)
    known = {row for row, _ in found}
    wanted = known if rows == "all" else {rows} if isinstance(rows, str) else set(rows)
    if missing := sorted(wanted - known) or ([] if wanted else ["features"]):
        raise InputError(
            f"no finished run of {', '.join(missing)} on {simulator} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={simulator} makes one"
        )
    return [found[key] for key in sorted(found) if key[0] in wanted]


def try_run(
    store: Store, run: Run, config: DictConfig, course: Course, overrides: Sequence[str], folder: Path
) -> str:
    """Try a run on streams, write what was found, and return it in one line.

    It is logged beside the run, and brought back from there when the same is asked again, unless
    ``tracking.resume=false``.

    Args:
        store: where runs are.
        run: a finished training.
        config: where runs are logged; the rest is the run's own, with the overrides.
        course: what to try.
        overrides: of the command line.
        folder: where files are written.

    Raises:
        InputError: overrides that do not fit the run, or a device that has no streams.
    """
    stored = configuration(store, run, config.trust)
    own = changed(stored, config, [one for one in overrides if not _ours(one)])
    asked = json.dumps([vars(course), fingerprint(own), run.data.tags.get(TAG)], sort_keys=True)
    tags = {"evaluated": run.info.run_id, "stream": hashlib.sha256(asked.encode()).hexdigest()[:16]}
    known = store.find("FINISHED", **tags) if config.tracking.resume else []
    if not known:
        _try(store, run, stored, own, course, tags)
        known = store.find("FINISHED", **tags)
    with TemporaryDirectory(dir=_made(folder)) as holder:
        fetched = download_artifacts(run_id=known[0].info.run_id, dst_path=holder, tracking_uri=store.uri)
        for path in Path(fetched).glob("stream_*"):
            path.replace(folder / path.name)
    return f"{run.info.run_name} ({run.info.run_id[:8]}): {known[0].data.tags['outcome']}"


def _try(
    store: Store, run: Run, stored: DictConfig, own: DictConfig, course: Course, tags: dict[str, str]
) -> None:
    device, learner = build_device(own), build_learner(own)
    restore(store, run, learner, build_data(own, device))
    point = operating_point(run, learner, stored, own.evaluation)
    point = point or OperatingPoint.default(own.evaluation.false_alarm_rate)
    progress = partial(track, description=run.info.run_name, console=Console(stderr=True), transient=True)
    found = slide(learner, device, course, point, progress)
    name = f"stream_{own.row}" + ("_streams" if found.streamed else "")
    with store.run(f"streams of {run.info.run_name}", tags, run.info.run_id) as logged:
        store.log_metrics(logged, found.metrics())
        store.client.set_tag(logged.info.run_id, "outcome", line(found))
        with TemporaryDirectory() as folder:
            title = f"{run.info.run_name}{' on streams' if found.streamed else ''}, run {run.info.run_id[:8]}"
            publish(found, title, Path(folder) / name)
            store.client.log_artifacts(logged.info.run_id, folder)


def _ours(override: str) -> bool:
    """Return whether an override steers this command and not the run."""
    return override.lstrip("+~").split("=")[0].split(".")[0] in _OWN


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
