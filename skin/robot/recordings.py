"""Recordings where robots keep them: sets of LeRobot, written and read, and MCAP files, written.

A set of LeRobot, version 3.0, is a folder of Parquet and JSON files (github.com/huggingface/lerobot,
``docs/source/lerobot-dataset-v3.mdx``). Each touch of a recording is an episode. Its features are float32:
``observation.tactile`` (S,), N, NaN where a reading means nothing; ``label.NAME``, 0, 1, or NaN where it is
unknown; and the columns of :mod:`skin.device.files`: ``saturated``, ``D_s`` and ``D_t`` (S,), ``force``,
``gesture_NAME`` and ``contact_00_x`` ... . The entry ``skin`` of the first, in ``meta/info.json``, has units,
positions, directions and all else that does not depend on the touches.

An MCAP file (mcap.dev) has JSON messages with JSON schemas; its metadata ``skin`` has the layout.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import PositiveFloat, PositiveInt

from skin.core.files import json_line, whole, write
from skin.core.safe_loading import parse_json, read_file
from skin.device import conversion, files
from skin.device.touches import Recording
from skin.errors import InputError
from skin.robot.mujoco_skin import load_package

TACTILE = "observation.tactile"


def _columns(about: dict[str, Any]) -> dict[str, list[str]]:
    """Return the columns of a recording that each feature has, by its description."""
    columns = pd.Series([*files.column_types(about)][2:])
    labelled = columns.mask(columns.isin(about["task"]["names"]), "label." + columns)
    arrays = {r"^reading_\d+$": TACTILE, r"^(saturated|D_s|D_t)_\d+$": r"\1"}
    return dict(columns.groupby(labelled.replace(arrays, regex=True), sort=False).agg(list))


def _values(recording: Recording, about: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the features of all frames, (B * T, S) or (B * T, 1), float32."""
    table = files.tabulate(recording, about)
    return {
        feature: np.stack([table[name].to_numpy() for name in names], axis=1).astype(np.float32)
        for feature, names in _columns(about).items()
    }


# LeRobot.


def write_lerobot(recording: Recording, folder: Path) -> None:
    """Write a recording as a set of LeRobot; ``info.json``, which makes it one, is written last.

    Args:
        recording: to write; its metadata ``directions`` are the normals of its sensors, if they are known.
        folder: a new one.

    Raises:
        InputError: the folder has files, or cannot be written.
    """
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} has files: give a new folder, as in out=FOLDER")
    about, task = files.describe_recording(recording), "touch the skin"
    row = np.arange(about["gestures"] * about["frames"])[:, None]
    values = _values(recording, about) | {
        "timestamp": (row % about["frames"] / about["rate"]).astype(np.float32),
        "frame_index": row % about["frames"],
        "episode_index": row // about["frames"],
        "index": row,
        "task_index": 0 * row,
    }
    first = np.arange(0, len(row), about["frames"])
    tables = {
        "data/chunk-000/file-000": {
            name: pa.FixedSizeListArray.from_arrays(block.ravel(), block.shape[1])
            if block.shape[1] > 1
            else block[:, 0]
            for name, block in values.items()
        },
        "meta/episodes/chunk-000/file-000": {
            "episode_index": first // about["frames"],
            "tasks": [[task]] * len(first),
            "length": 0 * first + about["frames"],
            "dataset_from_index": first,
            "dataset_to_index": first + about["frames"],
            **dict.fromkeys(("data/chunk_index", "data/file_index"), 0 * first),
            **dict.fromkeys(("meta/episodes/chunk_index", "meta/episodes/file_index"), 0 * first),
        },
        "meta/tasks": pd.DataFrame({"task_index": [0]}, index=pd.Index([task], name="task")),
    }
    for name, columns in tables.items():
        with whole(folder / f"{name}.parquet") as partial:
            pq.write_table(pa.table(columns), partial)
    statistics = {
        name: {
            kind: np.ma.filled(getattr(np.ma.masked_invalid(block), kind)(axis=0), 0).tolist()
            for kind in ("min", "max", "mean", "std")
        }
        | {"count": [len(row)]}
        for name, block in values.items()
    }
    write(json_line(statistics), folder / "meta" / "stats.json")
    write(json_line(_describe(about, values), indent=2), folder / "meta" / "info.json")


def _describe(about: dict[str, Any], values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the content of ``info.json``; LeRobot joins sets with equal features, so those are of the skin.

    Args:
        about: description of the recording.
        values: of each feature, (R, n).
    """
    shared = {"directions": about["metadata"].get("directions")}
    return {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": about["gestures"],
        "total_frames": about["gestures"] * about["frames"],
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": about["rate"] if about["rate"] % 1 else int(about["rate"]),
        "splits": {"train": f"0:{about['gestures']}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            name: {"dtype": str(block.dtype), "shape": [block.shape[1]], "names": None}
            | ({"skin": about | {"gestures": 0, "metadata": shared}} if name == TACTILE else {})
            for name, block in values.items()
        },
        "skin": about["metadata"],
    }


def read_lerobot(
    folder: Path,
    positions: conversion.Positions = None,
    size: tuple[float, float] | None = None,
    feature: str = TACTILE,
    scale: PositiveFloat = 1.0,
    frames: PositiveInt | None = None,
) -> Recording:
    """Read a set of LeRobot.

    One of :func:`write_lerobot` becomes the recording that it was. Of another, each episode is a touch, or
    several; a shorter one ends with readings that are not valid. The group of a touch is its episode.

    Args:
        folder: of the set.
        positions: of the sensors, in the order of the taxels; None: those of the set.
        size: extent (x, y) of their skin, m.
        feature: with the taxels.
        scale: N per unit of the feature.
        frames: of a touch: an episode is cut every so many; None: as the longest episode.

    Raises:
        InputError: no such feature, no positions, another number of sensors, or damaged.
    """
    path = folder / "meta" / "info.json"
    with files.refused(path):
        info = parse_json(read_file(path))
        if feature not in info["features"]:
            raise InputError(f"{path} has no feature {feature}: give one, options={{feature: NAME}}")
        about = info["features"][feature].get("skin")
        columns = _columns(about) if about else {feature: []}
        table = pq.read_table(
            folder / "data", columns=[*columns, "index", "episode_index", "frame_index"]
        ).sort_by("index")
        values = np.hstack(
            [np.array(table[name].to_pylist(), np.float32).reshape(len(table), -1) for name in columns]
        )
        if about:
            about |= {"gestures": info["total_episodes"], "metadata": info.get("skin", about["metadata"])}
            rows = pd.DataFrame(values, columns=[name for parts in columns.values() for name in parts])
            rows[["simulation", "frame"]] = table.select(["episode_index", "frame_index"]).to_pandas()
            return files.from_table(pa.Table.from_pandas(rows), about, files.check_description(about, path))
        if positions is None:
            raise InputError(
                f"{folder} has no positions of its sensors: give their layout and the size of the skin, as "
                "in layout=file layout.path=FILE.csv body.size=[0.1,0.1]"
            )
        episode, frame = (table[name].to_numpy() for name in ("episode_index", "frame_index"))
        frames = frames or int(frame.max()) + 1
        numbers, touch = np.unique([episode, frame // frames], axis=1, return_inverse=True)
        readings = np.full((numbers.shape[1], frames, values.shape[1]), np.nan, np.float32)
        readings[touch, frame % frames] = scale * values
        return conversion.build_recording(
            readings,
            float(info["fps"]),
            groups={"episode": [str(number) for number in numbers[0]]},
            about=f"LeRobot set {folder.name}",
            positions=positions,
            size=size,
        )


# MCAP.

_NUMBER, _TEXT, _FLAG = {"type": "number"}, {"type": "string"}, {"type": "boolean"}
LIVE: dict[str, dict[str, Any]] = {
    "readings": {
        "newtons": {"type": "array", "items": _NUMBER},
        "saturated": {"type": "array", "items": _FLAG},
        "device_time": _NUMBER,
    },
    "verdict": {
        **dict.fromkeys(("event", "state", "reason"), _TEXT),
        **dict.fromkeys(("alarm", "dangerous", "stale", "touched", "gap"), _FLAG),
        **dict.fromkeys(("device_time", "contact"), _NUMBER),
        **{name: {"type": "object", "properties": {}} for name in ("labels", "probabilities")},
    },
    "contacts": {
        "state": _TEXT,
        **dict.fromkeys(("number", "probability", "fit", "large", "device_time"), _NUMBER),
        "contacts": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": dict.fromkeys(
                    ("x", "y", "force", "force_deviation", "radius", "peak"), _NUMBER
                ),
            },
        },
    },
}
"""Topics of the live view -> main fields of their messages, as JSON schemas; docs/export.md has them all."""


def write_messages(
    package: Any,
    about: Mapping[str, Any],
    topics: Mapping[str, Mapping[str, Any]],
    file: IO[bytes],
    messages: Iterable[tuple[str, int, Mapping[str, Any]]],
) -> None:
    """Write an MCAP file in chunks of 16 kB, each of which outlives this process once it is complete.

    Args:
        package: ``mcap.writer``.
        about: the layout: entries of the metadata ``skin``.
        topics: name of each topic -> fields of its messages, as JSON schemas.
        file: open for writing.
        messages: topic, ns since 1970, and content of each.
    """
    writer = package.Writer(file, chunk_size=1 << 14)
    writer.start(library="tactile-skin")
    writer.add_metadata("skin", {name: json_line(entry) for name, entry in about.items()})
    channels = {
        name: writer.register_channel(
            f"/skin/{name}",
            "json",
            writer.register_schema(
                f"skin.{name}", "jsonschema", json_line({"type": "object", "properties": fields}).encode()
            ),
        )
        for name, fields in topics.items()
    }
    for topic, time, content in messages:
        writer.add_message(channels[topic], time, json_line(content).encode(), time)
        file.flush()
    writer.finish()


def live_messages(
    verdicts: Iterable[dict[str, Any]], frames: Any, epoch: float
) -> Iterator[tuple[str, int, Mapping[str, Any]]]:
    """Yield the messages of a live view: with each verdict its contacts, and the frames since the last.

    Args:
        verdicts: as JSON data, with ``contacts``.
        frames: deque of :class:`skin.wire.channels.NewtonFrame`, the oldest first, which are taken.
        epoch: s from 1970 to the beginning of the host's monotonic clock.
    """
    moment = 0
    for verdict in verdicts:
        while frames:
            readings = frames.popleft()
            yield (
                "readings",
                round(1e9 * (epoch + readings.frame.t_host)),
                {
                    "newtons": np.where(readings.usable, readings.newtons, np.nan).tolist(),
                    "saturated": readings.saturated.tolist(),
                    "device_time": readings.frame.t,
                },
            )
        # Two events of one verdict may be some milliseconds apart; readers sort messages by time.
        moment = max(moment, pd.Timestamp(verdict["time"]).value)
        yield "contacts", moment, verdict.pop("contacts")
        yield "verdict", moment, verdict


def write_mcap(recording: Recording, path: Path) -> None:
    """Write a recording as an MCAP file, one touch after the other, from 0 s on.

    The topic ``/skin/readings`` has the readings, ``/skin/touch`` what else is known of each frame: labels,
    force, and so on.

    Args:
        recording: to write.
        path: of the file.

    Raises:
        InputError: the package ``mcap`` is not installed, or the file cannot be written.
    """
    package, about = load_package("mcap.writer", "robot"), files.describe_recording(recording)
    values = {
        name.removeprefix("label."): block if block.shape[1] > 1 or name == TACTILE else block[:, 0]
        for name, block in _values(recording, about).items()
    }
    topics = {"readings": {"newtons": values.pop(TACTILE)}, "touch": values}
    with whole(path, "out=FILE.mcap") as partial, partial.open("wb") as file:
        write_messages(
            package,
            about,
            {
                topic: {
                    name: {"type": "array", "items": _NUMBER} if block.ndim > 1 else _NUMBER
                    for name, block in blocks.items()
                }
                for topic, blocks in topics.items()
            },
            file,
            (
                (
                    topic,
                    round(1e9 * row / about["rate"]),
                    {name: block[row].tolist() for name, block in blocks.items()},
                )
                for row in range(about["gestures"] * about["frames"])
                for topic, blocks in topics.items()
            ),
        )
