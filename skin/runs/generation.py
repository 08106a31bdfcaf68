"""Write the touches of a device to a file, or to a data set with flat memory."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from skin.body.base import require_memory
from skin.core.files import MANIFEST
from skin.device.base import AbstractDevice, in_threads
from skin.device.files import DataSet, describe_recording, write_manifest, write_recording
from skin.device.simulated import check_label_leakage, summary_line
from skin.device.touches import Part
from skin.errors import InputError
from skin.runs.configuration import iterate_leaves, settings_hash, source_tags


def generate_data_set(device: AbstractDevice, settings: Mapping[str, Any], folder: Path) -> str:
    """Write the touches of a device as a data set, and return a summary of it.

    Shards are drawn on as many threads as torch has. Each appears whole, and those that are in the folder
    already are not drawn again.

    Args:
        device: draws or reads the touches; simulated ones have no displacements.
        settings: its configuration, in plain containers.
        folder: new, empty, or with a part of the same data set.

    Raises:
        InputError: the folder has something else, or cannot be written.
    """
    if not (parts := list(device.parts() or [])):
        whole = device.recording()
        parts = [Part(len(whole), lambda: whole)]
    source = {"config_hash": settings_hash(settings), "config": json.loads(json.dumps(settings))}
    if not (folder / MANIFEST).is_file():
        _begin(device, parts, source, folder)
    data_set = DataSet(folder, complete=False)
    _compare(data_set.manifest, source, folder)
    _write_missing(parts, data_set)
    written = DataSet(folder)
    size = sum(written.path(number).stat().st_size for number in range(len(parts)))
    return f"{sum(written.counts)} gestures in {len(parts)} shards, {size / 1e6:.0f} MB"


def _begin(device: AbstractDevice, parts: list[Part], source: dict[str, Any], folder: Path) -> None:
    """Draw the first shard, check its labels, and write the manifest."""
    if folder.exists() and (not folder.is_dir() or any(folder.glob("[!.]*"))):
        raise InputError(f"{folder} exists and has no {MANIFEST}: add out= with a new or an empty folder")
    drawn = [parts[0].make()]
    check_label_leakage(device, drawn[0])
    code = {name: tag for name, tag in source_tags().items() if name.startswith("source_")}
    counts, seed = [part.count for part in parts], source["config"].get("seed")
    write_manifest(folder, describe_recording(drawn[0]), counts, seed=seed, **code, **source)
    parts[0] = Part(parts[0].count, drawn.pop)  # its memory is free once it is written


def _compare(manifest: Mapping[str, Any], source: Mapping[str, Any], folder: Path) -> None:
    """Check that a data set was begun with the same settings by the same code."""
    if manifest["config_hash"] != source["config_hash"]:
        before, now = (dict(iterate_leaves(part["config"])) for part in (manifest, source))
        changed = [path for path in before | now if before.get(path, ...) != now.get(path, ...)]
        differences = [
            f"{'.'.join(path)}={before.get(path)}, not {now.get(path)}"
            for path in sorted(changed, key=len)[:3]  # settings before what is derived from them
        ] or ["other contents of the files that its settings name, or another version"]
        raise InputError(
            f"{folder} was begun with {'; '.join(differences)}: repeat those settings, or add out= with a "
            "new folder"
        )
    if (begun := manifest["source_commit"]) != (commit := source_tags()["source_commit"]):
        raise InputError(
            f"{folder} was begun by the code of commit {begun[:12]}, this is {commit[:12]}: use that code, "
            "or add out= with a new folder"
        )


def _write_missing(parts: Sequence[Part], data_set: DataSet) -> None:
    """Draw and write the shards that a folder lacks."""
    missing, total = data_set.missing, sum(data_set.counts)
    if present := total - sum(parts[n].count for n in missing):
        print(f"{present} of {total} gestures are there already", file=sys.stderr)
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("gestures", total=total, completed=present)

        def write(turn: int) -> None:
            number = missing[turn]
            shard = parts[number].make()
            metadata = shard.metadata | {"config_hash": data_set.manifest["config_hash"]}
            first = data_set.firsts[number]
            write_recording(replace(shard, metadata=metadata), data_set.path(number), first)
            progress.advance(task, len(shard))

        in_threads(write, len(missing))


def generate_file(device: AbstractDevice, settings: Mapping[str, Any], path: Path) -> str:
    """Write the touches of a device as one recording, and return a summary of them.

    Args:
        device, settings: as of :func:`generate_data_set`.
        path: ``x.parquet``, or ``x.csv`` for the rows alone.

    Raises:
        InputError: the touches do not fit into memory, or the file cannot be written.
    """
    if (simulation := device.simulation) is not None:
        count = settings.get("data", {}).get("gestures", 0)
        # 40 bytes for each reading: with displacements, and a table of everything.
        needed = 40.0 * count * simulation.window * len(simulation.sensors)
        require_memory(needed, f"n={count} in one file", "add out=FOLDER for a data set, which needs less")
    recording = device.recording()
    check_label_leakage(device, recording)
    metadata = recording.metadata | {"config_hash": settings_hash(settings), "config": settings}
    write_recording(replace(recording, metadata=metadata), path)
    # The metadata of a file may have any content.
    return f"{len(recording)} gestures" if simulation is None else summary_line(recording.metadata["summary"])
