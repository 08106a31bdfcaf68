"""The code and the processor that produce a result."""

import atexit
import logging
import platform
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from skin import __version__
from skin.paths import BUNDLED, ROOT

if TYPE_CHECKING:
    from mlflow.entities import Run

_log = logging.getLogger(__name__)
_FOLDERS = ("skin", "experiments", "conf", "data")  # results depend on nothing else in the repository
_reused: dict[str, str] = {}  # id -> name of reused runs of other code


@cache
def source_tags() -> dict[str, str]:
    """Return the tags ``source_commit`` and ``source_dirty`` of the code, and ``processor``.

    ``source_commit`` is the last commit that changed the code; without git, the version of the package.
    ``source_dirty`` is ``true`` if files differ from that commit, ``false`` if none does, and ``unknown``
    without git.
    """
    commit, dirty = _git("log", "-1", "--format=%H", "--", *_FOLDERS), "unknown"
    if commit:
        dirty = "true" if _git("status", "--porcelain", "--", *_FOLDERS) else "false"
    return {
        "source_commit": commit or __version__,
        "source_dirty": dirty,
        "processor": _processor(),
    }


def _git(*arguments: str) -> str | None:
    """Return the output of git in the repository; None without git."""
    if BUNDLED != ROOT:  # a wheel, which may be installed inside another repository
        return None
    try:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _processor() -> str:
    """Return the name of the processor, with its family and model where the system tells them."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    known = dict(re.findall(r"^(model name|cpu family|model)\s*:\s*(.+)$", text, re.MULTILINE))
    if not known:
        return platform.processor() or platform.machine() or "unknown"
    return ", ".join(
        part for part in (
            known.get("model name"),
            f"family {known['cpu family']}" if "cpu family" in known else None,
            f"model {known['model']}" if "model" in known else None,
        ) if part
    )  # fmt: skip


def note_reuse(run: "Run") -> None:
    """Note that this command uses a finished run.

    At exit, one warning counts the runs of other code: of another commit, or with files that differ from the
    commit then or now. Runs that began after this process do not count.
    """
    if run.info.start_time < 1000 * psutil.Process().create_time():
        note_source(run.info.run_id, run.info.run_name, run.data.tags)


def note_source(identity: str, name: str, tags: Mapping[str, str]) -> None:
    """Note that this command uses an earlier result with some tags (:func:`source_tags`)."""
    own = source_tags()
    same = tags.get("source_commit") == own["source_commit"]
    if not same or "true" in (tags.get("source_dirty"), own["source_dirty"]):
        _reused.setdefault(identity, name)


@atexit.register
def _warn() -> None:
    """Print the warning that :func:`note_reuse` announces."""
    if not _reused:
        return
    count, first = len(_reused), next(iter(_reused.values()))
    what = f"finished run {first}" if count == 1 else f"{count} finished runs, such as {first}"
    _log.warning(
        "warning: reused %s, of other code (tags source_commit and source_dirty): "
        "tracking.resume=false repeats them",
        what,
    )
