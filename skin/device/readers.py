"""Readers of what is no plain table: ``skin convert reader=skin.device.readers.cost``.

Those of public data sets are examples of a function of one's own: it takes the path and its options, and
returns a recording.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from annotated_types import Ge, Le
from pydantic import PositiveFloat

from skin.body.layout import tile_centres
from skin.device.conversion import build_recording
from skin.device.formats import FORCES, parse_numbers, require_columns
from skin.device.touches import Recording
from skin.errors import InputError

DOI = "doi:10.4121/uuid:5ef62345-3b3e-479c-8e1d-c922748c9b29"
COST = f"https://doi.org/{DOI[4:]}"
_WORDS = "grab hit massage pat pinch poke press rub scratch slap squeeze stroke tap tickle"
GESTURES = tuple(_WORDS.split())
VARIANTS = ("gentle", "normal", "rough")
"""Names of the corpus's numbers, which count from 1."""


def cost(
    path: Path,
    gestures: Sequence[str] = GESTURES,
    variants: bool = False,
    taxels: Sequence[Annotated[int, Ge(1), Le(64)]] = range(1, 65),
    window: Annotated[int, Ge(2)] = 30,
    pitch: PositiveFloat | None = None,
) -> Recording:
    """Read the Corpus of Social Touch: 7805 captures of 14 gestures by 31 subjects on 8 x 8 textile taxels.

    Jung, Poel, Poppe, Heylen, J. Multimodal User Interfaces 11, 2017; for non-commercial use. The counts are
    not calibrated: 10 N are nominally 1023 counts. A capture has 10 to 1747 frames at 135 Hz; each is
    resampled to ``window`` frames over its whole length, so the duration is lost. The group is the subject.

    Args:
        path: ``CoST.csv``.
        gestures: those to keep.
        variants: whether gentle, normal and rough are classes of their own.
        taxels: channels to keep, from 1.
        window: frames per touch.
        pitch: between neighbouring taxels, m; channels 1 to 8 are the upper row. None: unknown positions.

    Raises:
        InputError: no such file, or another format.
    """
    chosen = np.unique(taxels) - 1
    try:
        table = pd.read_csv(path.expanduser(), skipinitialspace=True, low_memory=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read {path}: {' '.join(str(error).split())}; CoST.csv is at {COST}"
        ) from error
    channels = [f"ch{number + 1}" for number in chosen]
    require_columns(table, ["subject", "variant", "gesture", "frame", *channels], path, f"CoST.csv of {COST}")
    scaled = [0.0097752 * parse_numbers(table, name, path) for name in channels]
    values = np.stack(scaled, axis=1).astype(np.float32)
    begins = np.append(True, np.diff(table["frame"]) <= 0)
    begins[1:] |= (np.diff(table[["subject", "variant", "gesture"]], axis=0) != 0).any(axis=1)
    rows = [slice(*pair) for pair in pairwise([*np.flatnonzero(begins), len(table)])]
    firsts = table.iloc[[part.start for part in rows]]
    gesture, variant, subject = firsts[["gesture", "variant", "subject"]].to_numpy().T
    words = [GESTURES[int(number) - 1] for number in gesture]
    kept = [n for n, word in enumerate(words) if word in gestures]
    if not kept:
        raise InputError(f"{path} has no capture of {', '.join(gestures)}: CoST.csv is at {COST}")
    ways = [f"_{VARIANTS[int(number) - 1]}" if variants else "" for number in variant]
    lengths = np.array([max(1, rows[n].stop - rows[n].start - 1) for n in kept])
    return build_recording(
        np.stack([_stretch(values[rows[n]], window) for n in kept]),
        float(np.median(135.0 * (window - 1) / lengths)),
        groups={"subject": [str(int(subject[n])) for n in kept]},
        kinds=[words[n] + ways[n] for n in kept],
        names=[f"{name}_{way}" for name in gestures for way in VARIANTS] if variants else gestures,
        about=f"Corpus of Social Touch, M. Jung, {DOI}, for non-commercial use",
        positions="unknown" if pitch is None else (8 * pitch * tile_centres(8, 8)[chosen]).tolist(),
        size=None if pitch is None else (8 * pitch, 8 * pitch),
        footprint=(0.01, 0.01) if pitch is None else (pitch, pitch),
    )


def _stretch(values: np.ndarray, frames: int) -> np.ndarray:
    """Return rows (R, S) resampled to so many frames, (frames, S)."""
    times = np.linspace(0, len(values) - 1, frames)
    before = np.minimum(times.astype(int), max(len(values) - 2, 0))
    fraction = (times - before)[:, None].astype(np.float32)
    return values[before] * (1 - fraction) + values[np.minimum(before + 1, len(values) - 1)] * fraction


_EPI = ("hold", "rub", "pat", "pick", "poke", "press", "scratch", "slap", "stroke", "tap", "tickle")
# Labels of the report by the names of the gestures; others are unknown: no force, and pat and pick repeat.
_EPI_LABELS = {
    "big": {0: 1, 1: 1, 2: 1, 7: 1, 8: 1, 3: 0, 4: 0, 5: 0, 6: 0, 9: 0, 10: 0},  # with the hand
    "dynamic": {1: 1, 6: 1, 8: 1, 10: 1, 0: 0, 2: 0, 4: 0, 5: 0, 7: 0, 9: 0},
    "press": {0: 1, 1: 1, 5: 1, 6: 1, 8: 1, 10: 1, 4: 0, 7: 0, 9: 0},
}


def epi(path: Path, frames: int = 100, duration: PositiveFloat = 3.5) -> Recording:
    """Read the touches of the head of the robot Epi: 11 gestures on 12 electrodes, without a stated licence.

    Each row holds all frames of the first electrode, then of the second, and so on.

    Args:
        path: folder of ``training_data_x.csv`` and ``training_data_y.csv``, of
            github.com/axelholmqvist/humanoid-touch-classification.
        frames: per touch.
        duration: of a touch, s.

    Raises:
        InputError: no such files, or a row of another length.
    """
    try:
        values, kinds = (
            pd.read_csv(path.expanduser() / f"training_data_{name}.csv", header=None) for name in "xy"
        )
        readings = (0.1 * values.to_numpy(dtype=float)).astype(np.float32)
        numbers = kinds.to_numpy(dtype=int).ravel()
        touches = readings.reshape(len(numbers), -1, frames).swapaxes(1, 2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} has no touches of Epi: {' '.join(str(error).split())}") from error
    return build_recording(
        np.ascontiguousarray(touches),
        round(frames / duration, 2),
        labels={name: [its.get(number) for number in numbers] for name, its in _EPI_LABELS.items()},
        kinds=[_EPI[number] for number in numbers],
        names=_EPI,
        about="Epi, A. Holmqvist, M. Karlsson and M. Mirstroem, "
        "github.com/axelholmqvist/humanoid-touch-classification, no licence stated",
    )


def eflesh(path: Path) -> Recording:
    """Read presses of eFlesh, magnetometers under a printed lattice; each row is a touch of five frames.

    Targets are the force of the gauge, where there is one, with the label ``dangerous`` above 10 N, an
    example; or the position of the probe, with the labels ``right`` and ``low``. The group is the session.

    Args:
        path: a folder of characterization/datasets of github.com/notvenky/eFlesh.

    Raises:
        InputError: no such files, or files of different lengths.
    """
    files = sorted(path.expanduser().glob("*/sensor_post_baselines.csv"))
    if not files:
        raise InputError(f"{path} has no file */sensor_post_baselines.csv: give a folder of eFlesh")
    try:
        tables = [pd.read_csv(file, header=None) for file in files]
        states = [pd.read_csv(file.with_name("states.csv"), header=None) for file in files]
        if list(map(len, tables)) != list(map(len, states)):
            raise ValueError("states.csv needs as many rows in the same order")
        fields = pd.concat(tables).to_numpy(dtype=float)[:, 1:]
        session = np.repeat([file.parent.name for file in files], list(map(len, tables)))
        _, x, y, _, *gauge = pd.concat(states).to_numpy(dtype=float).T
    except (OSError, ValueError) as error:
        raise InputError(f"{path} has no presses of eFlesh: {' '.join(str(error).split())}") from error
    readings = np.zeros((len(fields), 5, fields.shape[1]), np.float32)
    readings[:, 2] = 0.1 * fields  # the scale is nominal
    place = {"x": 1e-3 * (x - 274), "y": 1e-3 * (y + 115)}
    # Gram is inferred: it reproduces the published error. -1 stands for no value.
    targets = {"force": FORCES["g"] * np.where(gauge[0] == -1, np.nan, gauge[0])} if gauge else place
    limits = {"dangerous": ("force", 10.0)} if gauge else {"right": ("x", 0.015), "low": ("y", 0.015)}
    return build_recording(
        readings,
        10.0,  # nominal, of presses without a time
        targets={name: values.tolist() for name, values in targets.items()},
        labels={
            label: [None if np.isnan(value) else int(value > limit) for value in targets[name]]
            for label, (name, limit) in limits.items()
        },
        groups={"session": session.tolist()},
        about="eFlesh, github.com/notvenky/eFlesh, MIT License, Copyright (c) 2025 Venkatesh Pattabiraman",
        per_sensor=3,
        size=None if gauge else (0.03, 0.03),
    )
