"""A finished run: what it is called, its configuration, its weights and the threshold of its alarm.

Runs are in MLflow, or in folders of ``models/``: pretrained models. Such a folder holds ``run.json``
(:data:`RECORD`), ``config.yaml``, the file of weights, ``README.md`` (the card), and ``SHA256SUMS`` with the
hashes of the others, which ``sha256sum --check`` reads.
"""

import json
import pickle
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, cast
from urllib.parse import urlsplit
from urllib.request import url2pathname

from annotated_types import Ge, Le
from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin import __version__
from skin.core.files import candidates, unwritable
from skin.core.messages import one_line
from skin.core.safe_loading import TEXT, load_yaml, parse_json, read_file, regular, sha256
from skin.core.settings import check_targets, configured
from skin.errors import InputError
from skin.evaluation.operating_point import OperatingPoint, parse_operating_point
from skin.runs.configuration import (
    Config,
    Tracking,
    iterate_leaves,
    recompose,
    reveal_password,
    settings_of,
    validate_config,
)

if TYPE_CHECKING:
    from mlflow.entities import Run

    from skin.learning.data import TouchData
    from skin.learning.learner import AbstractLearner
    from skin.runs.store import Store

TAG = "operating_point"
"""Tag of a run that holds :meth:`OperatingPoint.text`; ``null`` where the task has no ``dangerous``."""
FORMAT = 1
"""Version of the content of a folder. Raise it when older folders can no longer be read."""
MODELS = "models"
"""The folder of all pretrained models, in the current folder and beside the package."""
RECORD, CONFIG, CARD, SUMS = "run.json", "config.yaml", "README.md", "SHA256SUMS"
PROCESS = "process"
"""Tag of a run: the number of the process that makes it."""
_TEMPLATE = Path(__file__).with_name("card.md")
_LARGEST = 4_000_000  # bytes of weights

# Errors of loading a file that is damaged or belongs to another learner.
_UNFIT = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    pickle.PickleError,
)


@dataclass(frozen=True)
class FinishedRun:
    """A training run that finished.

    Attributes:
        store: where it is; None: a pretrained model, which needs no database.
        run: as MLflow has it; for a pretrained model, the run that it is a copy of.
        trust: its configuration may run any code.
    """

    store: "Store | None"
    run: "Run"
    trust: bool = False

    @property
    def identity(self) -> str:
        """The id of the run."""
        return str(self.run.info.run_id)

    @property
    def title(self) -> str:
        """The name of the run."""
        return str(self.run.info.run_name)

    @cached_property
    def stored(self) -> Config:
        """The configuration of the run.

        Raises:
            InputError: it cannot be read, is that of another version, or names a class that is not allowed
                (:mod:`skin.core.settings`).
        """
        try:
            with TemporaryDirectory() as folder:
                stored = load_yaml(self.fetch(CONFIG, folder))
            if not isinstance(stored, dict) or not all(isinstance(key, str) for key in stored):
                raise ValueError("it holds no settings")
        except (ValueError, OSError) as error:
            raise InputError(f"run {self.identity} has no readable config.yaml: {error}") from error
        if not self.trust:
            check_targets(stored, f"config.yaml of run {self.identity}")
        try:
            return validate_config(stored)
        except InputError as error:
            raise InputError(
                f"config.yaml of run {self.identity} does not fit this version: {error}: train it again"
            ) from error

    def configured(self, overrides: Sequence[str]) -> Config:
        """Return the configuration with the overrides of a command line."""
        return recompose(self.stored, overrides)

    @property
    def point(self) -> OperatingPoint | None:
        """The stored operating point of the alarm; None: none is stored, or the task has no alarm.

        Raises:
            InputError: it cannot be read.
        """
        return parse_operating_point(self.run.data.tags.get(TAG, "null"))

    @contextmanager
    def reading(self, name: str, refused: str) -> Iterator[None]:
        """Turn what goes wrong with a stored file into an InputError: it may be damaged.

        Args:
            name: of the file.
            refused: what it is then, such as ``is damaged``.
        """
        try:
            yield
        except (InputError, OmegaConfBaseException):
            raise
        except (*_UNFIT, AssertionError, InstantiationException) as error:
            cause = error.__cause__ if isinstance(error, InstantiationException) else None
            reason = _reason(cause or error)
            raise InputError(f"{name} of run {self.identity} {refused}: {reason}") from error

    def load_weights(self, learner: "AbstractLearner", data: "TouchData") -> None:
        """Load the weights into a learner.

        Raises:
            InputError: the weights do not fit the touches, such as another window with early fusion.
        """
        name = self.run.data.tags["learned"]
        if Path(name).name != name:
            raise InputError(
                f"run {self.identity} names {name!r} as what it learned, a file of something else"
            )
        refused = "is damaged or does not fit these touches"
        with TemporaryDirectory() as folder, self.reading(name, refused):
            learner.load(data, self.fetch(name, folder))

    def fetch(self, name: str, folder: str) -> Path:
        """Copy a file or folder of the run into ``folder`` and return its path.

        Raises:
            InputError: the run does not have it, or it cannot be read.
        """
        position = self.run.info.artifact_uri
        parts = urlsplit(position)
        try:
            if not parts.netloc and parts.scheme in ("", "file"):  # a folder of this machine
                local = Path(url2pathname(parts.path) if parts.scheme else position) / name
                copy = Path(folder) / name
                return Path(
                    shutil.copytree(local, copy, copy_function=_copy)
                    if local.is_dir()
                    else _copy(local, copy)
                )
            from mlflow.artifacts import download_artifacts

            assert self.store is not None
            uri = reveal_password(self.store.uri)
            return Path(download_artifacts(f"{position}/{name}", None, None, folder, uri))
        except Exception as error:  # of the file system, of MLflow, or of the library of another storage
            raise InputError(f"run {self.identity} has no {name} in {position}: {one_line(error)}") from error


def find_run(tracking: Tracking, name: str, trust: bool = False) -> FinishedRun:
    """Return a pretrained model, or the finished training run whose id or fingerprint begins with ``name``.

    A model is named or given by its folder, as in ``./my_skin``. ``latest`` is the last finished run that has
    weights. Of runs with equal fingerprints the last one counts. No database is opened for a model.

    Raises:
        InputError: no run or more than one matches, or the files of the model were altered.
    """
    if (pretrained := find_pretrained(name)) is not None:
        return FinishedRun(None, pretrained, trust)
    from skin.runs.store import Store  # MLflow takes seconds to import

    store = Store.existing(tracking)
    runs = [run for run in store.find("FINISHED") if "learned" in run.data.tags]
    if name == "latest":
        matches = runs[:1]
    else:
        prints = {run.data.tags.get("fingerprint", ""): run for run in reversed(runs)}
        matches = [run for run in runs if run.info.run_id.startswith(name)]
        matches = matches or [run for value, run in prints.items() if value.startswith(name)]
    if not matches:
        raise InputError(f"no finished training run {name} in {store.uri}: skin train makes one")
    if len(matches) > 1:
        raise InputError(f"{len(matches)} runs have an id that begins with {name}: give more of it")
    return FinishedRun(store, matches[0], trust)


def _copy(path: str | Path, copy: str | Path) -> str | Path:
    """Copy a file and return the copy; ValueError for a device or a named pipe, which would never end."""
    regular(Path(path))
    return shutil.copyfile(path, copy)


def _reason(error: BaseException) -> str:
    """Return a short message; that of torch on a pickle would advise to run its code."""
    if isinstance(error, pickle.PickleError):
        return "it holds something else than numbers"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _read_entries(
    run: str,
    start_time: Annotated[int, Ge(0), Le(2**53)],
    tags: dict[str, str],
    metrics: dict[str, float],
) -> None:
    """Name what is read of :data:`RECORD`, with its types; ``start_time`` in ms since 1970."""


def find_pretrained(name: str) -> "Run | None":
    """Return a pretrained model as the finished run that it is a copy of; None if no model has this name.

    The artifacts of the run are the files of the folder.

    Args:
        name: of the model, or the path of its folder, which has a ``/``.

    Raises:
        InputError: the folder has another format, or a file of it was altered.
    """
    folder: Path | None = Path(name).expanduser().resolve()
    if "/" not in name or not (folder / RECORD).is_file():  # type: ignore[operator]
        named = candidates(Path(MODELS) / name) if is_name(name) else []
        folder = next((path.resolve() for path in named if path.is_dir()), None)
    if folder is None:
        return None
    record = _record(folder)
    info = SimpleNamespace(
        run_id=record["run"],
        start_time=record["start_time"],
        end_time=record["start_time"],  # a record does not say when the training ended
        artifact_uri=folder.as_uri(),
        run_name=folder.name,
        weights=folder / record["tags"]["learned"],
    )
    data = SimpleNamespace(metrics=record["metrics"], tags=record["tags"])
    return cast("Run", SimpleNamespace(info=info, data=data))


def is_name(name: str) -> bool:
    """Return whether a model may have this name: lower-case letters, digits and ``_``, and no id of a run."""
    allowed = re.fullmatch(r"[a-z][a-z0-9_]*", name) is not None
    return allowed and name != "latest" and re.fullmatch("[0-9a-f]+", name) is None


def checksums(folder: Path, learned: str) -> str:
    """Return the hashes of the files of a model, as ``sha256sum`` writes them.

    Args:
        folder: with the files.
        learned: name of the file of weights.
    """
    return "".join(
        f"{sha256(read_file(folder / name))}  {name}\n" for name in sorted((RECORD, CONFIG, CARD, learned))
    )


def _record(folder: Path) -> dict[str, Any]:
    """Return the content of :data:`RECORD`, after the format and the hashes were checked.

    Raises:
        InputError: the folder is not as it was written.
    """
    try:
        record = parse_json(read_file(folder / RECORD, TEXT))
        version = record["format"]
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{folder} is no pretrained model, {RECORD} cannot be read: {error}") from error
    again = "write it again with skin export format=folder"
    if version != FORMAT:
        raise InputError(
            f"{folder} has format {version!r} and this version reads format {FORMAT}: install the version of "
            f"the package that wrote it, or {again}"
        )
    try:
        listed = read_file(folder / SUMS, TEXT).decode("utf-8").splitlines()
        current = checksums(folder, Path(record["tags"]["learned"]).name).splitlines()
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"{folder} is no complete pretrained model: {error}") from error
    if altered := [line.split()[1] for line in current if line not in listed]:
        raise InputError(
            f"{', '.join(altered)} in {folder} differs from {SUMS}: restore the folder, or {again}"
        )
    needed = {name: record[name] for name in _read_entries.__annotations__ if name in record}
    configured(_read_entries, needed, f"{RECORD} of {folder}")
    return record


# Write a folder of ``models/``, and its card: how a model was trained and measured, what it is not for.


def check_folder(name: str | None, licence: str | None) -> Path:
    """Return the folder of a new model.

    Args:
        name: of the model.
        licence: of its weights.

    Raises:
        InputError: one is missing, or there is such a model.
    """
    if name is None or not is_name(name):
        raise InputError(
            f"name={name} is no name of a model: use lower-case letters, digits and _, as in name=my_skin"
        )
    if licence is None:
        raise InputError("the weights have no licence: add licence=MIT, or another one")
    folder = Path(MODELS) / name
    if folder.exists():
        raise InputError(f"{folder} exists: delete it, or give the model another name")
    return folder


def write_folder(run: FinishedRun, folder: Path, licence: str) -> None:
    """Write the files of a model, all or none.

    Args:
        run: whose weights and figures they hold.
        folder: new.
        licence: of the weights.

    Raises:
        InputError: the run has too many weights, or the folder cannot be written.
    """
    # Without the machine and the folders of the training.
    omitted = ("tracking", "trust")
    settings = {key: value for key, value in settings_of(run.stored).items() if key not in omitted}
    tags, metrics = run.run.data.tags, run.run.data.metrics
    record = {
        "format": FORMAT,
        "version": __version__,
        "licence": licence,
        "run": run.identity,
        "start_time": run.run.info.start_time,
        "tags": {key: tag for key, tag in tags.items() if key != PROCESS and not key.startswith("mlflow.")},
        "metrics": {key: value for key, value in metrics.items() if "/" in key or key == "parameters"},
    }
    try:
        folder.parent.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as partial:
            made = Path(partial) / folder.name
            made.mkdir()
            weights = run.fetch(tags["learned"], str(made))
            if weights.is_dir() or weights.stat().st_size > _LARGEST:
                raise InputError(
                    f"the weights of {run.title} are not one file of at most {_LARGEST / 1e6:g} MB: choose "
                    "the run of a smaller network"
                )
            (made / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            (made / CONFIG).write_text(OmegaConf.to_yaml(OmegaConf.create(settings)), encoding="utf-8")
            (made / CARD).write_text(model_card(folder.name, record, settings), encoding="utf-8")
            (made / SUMS).write_text(checksums(made, weights.name), encoding="utf-8")
            made.rename(folder)
    except OSError as error:
        raise unwritable(folder, error, "another current folder") from error


def model_card(name: str, record: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card of a model in Markdown, by the template ``card.md``.

    Args:
        name: of the model.
        record: content of ``run.json`` (:mod:`skin.runs.run`).
        config: configuration of the run, in plain containers.
    """
    from jinja2 import Environment

    from skin.evaluation.report import PERCENTAGES, format_number

    network = "model" in config["learner"]
    measured = [metric.split("/", 1) for metric in record["metrics"] if metric.count("/") == 2]
    fractions = (*PERCENTAGES, "/balanced_accuracy", "/ece")  # in per cent
    template = Environment(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True).from_string(
        _TEMPLATE.read_text(encoding="utf-8")
    )
    return template.render(
        record,
        name=name,
        config=config,
        settings=_settings,
        network=["representation", "model", "fusion"] if network else [],
        trained=["optimizer", "trainer"] if network else [],
        point=parse_operating_point(record["tags"]["operating_point"]),
        day=datetime.fromtimestamp(record["start_time"] / 1000, UTC),
        columns=dict.fromkeys(column for column, _ in measured),
        rows=dict.fromkeys(row for _, row in measured),
        cell=lambda value, row: format_number(value, 100 if row.endswith(fractions) else 1),
    )


def _settings(group: Mapping[str, Any], *without: str) -> str:
    """Return the class of a group, if it has one, and its settings; nested ones as ``outer.inner``."""
    settings = {key: value for key, value in group.items() if key not in without}
    name = [f"`{settings['_target_']}`"] if "_target_" in settings else []
    texts = [
        f"{'.'.join(path)}={str(value).replace('|', '/')}"
        for path, value in iterate_leaves(settings)
        if not path[-1].startswith("_") and value not in (None, {})
    ]
    return " ".join([*name, ", ".join(texts)]).strip()
