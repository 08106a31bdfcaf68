"""A data set: a folder of recordings, its shards, with a manifest.

``manifest.json`` has the schema of the shards and its version, the units, the seed, the source commit and the
configuration. ``shards/00000.parquet`` and so on are recordings (:mod:`skin.recording_file`); the column
``simulation`` numbers the touches of all shards.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, MinLen

from skin import files
from skin.errors import InputError
from skin.paths import MANIFEST
from skin.recording import Recording
from skin.recording_file import read_description, read_recording
from skin.recording_metadata import FORMAT, UNITS, column_types
from skin.settings import check_settings

_Count = Annotated[int, Ge(1)]
_AGAIN = "delete it, and repeat the skin generate that made the data set, which draws it again"


@dataclass(frozen=True)
class Manifest:
    """Description of a data set.

    Attributes:
        version: of the schema.
        columns: name of each column of a shard -> its type.
        units: quantity -> its unit; columns without one are numbers.
        gestures: number of touches in all shards.
        frames: of each touch.
        rate: frames per second, Hz.
        seed: of the gestures.
        source_commit: last commit of the code that draws them; without git, the version of the package.
        source_dirty: whether files differed from that commit: true, false or unknown.
        config_hash: of the configuration, of the files that it names and of the version of the package.
        config: the configuration.
        shards: number of touches of each shard.
    """

    version: int
    columns: dict[str, str]
    units: dict[str, str]
    gestures: _Count
    frames: _Count
    rate: Annotated[float, Gt(0)]
    seed: int | None
    source_commit: str
    source_dirty: str
    config_hash: str
    config: dict
    shards: Annotated[list[_Count], MinLen(1)]

    @classmethod
    def of(cls, about: dict[str, Any], shards: Sequence[int], **source: Any) -> "Manifest":
        """Return the manifest of shards.

        Args:
            about: description of any of them (:func:`skin.recording_metadata.describe_recording`).
            shards: number of touches of each.
            source: seed, source_commit, source_dirty, config_hash and config.
        """
        columns = {name: str(kind) for name, kind in column_types(about).items()}
        counts = sum(shards), about["frames"], about["rate"]
        return cls(FORMAT, columns, UNITS, *counts, shards=list(shards), **source)

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Return the manifest in a folder.

        Raises:
            InputError: there is none, it is damaged, or of another version.
        """
        path = folder / MANIFEST
        if not path.is_file():
            raise InputError(
                f"{folder} is no data set, because it has no {MANIFEST}: give a folder that skin generate "
                f"n=1000 out={folder.name} made"
            )
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path} is damaged: {error}: restore it, or generate the data again") from error
        if isinstance(stored, dict) and stored.get("version", FORMAT) != FORMAT:
            raise InputError(
                f"{path} has schema version {stored['version']}, this program reads version {FORMAT}: "
                "use the program that wrote it, or generate the data again"
            )
        check_settings(cls, stored, str(path), whole=True)
        manifest = cls(**{name: value for name, value in stored.items() if name in cls.__annotations__})
        if manifest.units != UNITS or sum(manifest.shards) != manifest.gestures:
            raise InputError(
                f"{path} is damaged: its units or counts are not those that were written: generate the data "
                "again"
            )
        return manifest

    def write(self, folder: Path) -> None:
        """Write the manifest into a folder."""
        files.write(files.json_line(vars(self), indent=1) + "\n", folder / MANIFEST)

    def path(self, folder: Path, number: int) -> Path:
        """Return the path of a shard."""
        return folder / "shards" / f"{number:05d}.parquet"

    def missing(self, folder: Path) -> list[int]:
        """Return the numbers of the shards that are not in a folder."""
        return [n for n in range(len(self.shards)) if not self.path(folder, n).is_file()]

    @property
    def firsts(self) -> list[int]:
        """The number of the first touch of each shard."""
        return list(accumulate(self.shards[:-1], initial=0))


class DataSet:
    """A complete data set in a folder.

    Opening it reads the manifest and the description of every shard, but no touches.

    Args:
        folder: as ``skin generate out=FOLDER`` wrote it.

    Attributes:
        manifest: its manifest.
        counts: number of touches of each shard.

    Raises:
        InputError: there is no manifest, or a shard is missing, damaged or of another data set.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        self.manifest = Manifest.read(self.folder)
        self.counts = self.manifest.shards
        if missing := self.manifest.missing(self.folder):
            raise InputError(
                f"{self.folder} is not complete, {len(missing)} of {len(self.counts)} shards are missing, as "
                f"{self.path(missing[0]).name} is: repeat the skin generate that made it, which adds them"
            )
        for number, (count, first) in enumerate(zip(self.counts, self.manifest.firsts, strict=True)):
            with _mended():
                about = read_description(self.path(number))
            expected = about["gestures"], about.get("first"), about["metadata"].get("config_hash")
            if expected != (count, first, self.manifest.config_hash):
                raise InputError(f"{self.path(number)} is not the shard that {MANIFEST} describes: {_AGAIN}")

    def path(self, number: int) -> Path:
        """Return the path of a shard."""
        return self.manifest.path(self.folder, number)

    def read(self, number: int, complete: bool = True) -> Recording:
        """Return the touches of a shard; ``complete`` adds force and parameters.

        Raises:
            InputError: the shard is damaged.
        """
        with _mended():
            return read_recording(self.path(number), complete)


@contextmanager
def _mended() -> Iterator[None]:
    """Add to an InputError about a shard what to do."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{error}: {_AGAIN}") from error
