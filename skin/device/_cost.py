"""Captures of CoST.csv: read in bounded memory, checked, resampled."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from rich.console import Console
from rich.progress import wrap_file

from skin.errors import InputError

SOURCE = "https://doi.org/10.4121/uuid:5ef62345-3b3e-479c-8e1d-c922748c9b29"
ROWS, CAPTURES = 1_496_855, 7805
"""Number of rows and captures of the published file."""
FULL = 1023
"""The largest count: the corpus has 10 bits."""
CHANNELS = 64
COLUMNS = ("subject", "variant", "gesture", "frame", *(f"ch{1 + number}" for number in range(CHANNELS)))

_HEAD, _FRAME = 4, 3
_BLOCK = 1 << 22
_LARGEST = {"variant": 3, "gesture": 14}


@dataclass(frozen=True)
class Captures:
    """N captures, resampled to T frames each.

    Attributes:
        counts: (N, T, 64), float32, 0 to ``FULL``.
        subject: (N,), int32, as in the file.
        variant: (N,), int32: 1 gentle, 2 normal, 3 rough.
        gesture: (N,), int32, 1 to 14.
        frames: (N,), int32: number of frames of each in the file.
    """

    counts: np.ndarray
    subject: np.ndarray
    variant: np.ndarray
    gesture: np.ndarray
    frames: np.ndarray

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, index: np.ndarray) -> "Captures":
        """Return the captures that ``index`` selects."""
        return Captures(**{name: values[index] for name, values in vars(self).items()})


def format_error(path: str | Path, wrong: str, fix: str = "download it again") -> InputError:
    """Return the error for a file that is not as published, with the address of the corpus."""
    return InputError(f"{path} is not CoST.csv as published: {wrong}; {fix} from {SOURCE}")


def read_captures(path: Path, window: int) -> Captures:
    """Read the captures of a file block by block, in bounded memory.

    A capture begins where ``frame`` is 1. It is resampled by linear interpolation in time over its whole
    length, so its duration is kept only in ``frames``.

    Raises:
        InputError: the file is not in the corpus's format; the message has the number of the line.
    """
    parts: list[Captures] = []
    rest = np.empty((0, len(COLUMNS)), np.int32)
    line = 2
    for block in _blocks(path):
        rows = np.concatenate([rest, block])
        _check(path, rows, len(rest), line)
        line += len(block)
        # The last capture may continue in the next block.
        last = np.flatnonzero(rows[:, _FRAME] == 1)[-1]
        parts.append(_resampled(path, rows[:last], window, line - len(rows)))
        rest = rows[last:]
    if not len(rest):
        raise format_error(path, "it has no rows")
    parts.append(_resampled(path, rest, window, line - len(rest)))
    names = [field.name for field in fields(Captures)]
    return Captures(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _blocks(path: Path) -> Iterator[np.ndarray]:
    """Yield the rows of a file, (R, 68), int32, block by block."""
    _check_header(path)
    settings = {
        "read_options": pa.csv.ReadOptions(
            column_names=COLUMNS, skip_rows=1, block_size=_BLOCK, use_threads=False
        ),
        "convert_options": pa.csv.ConvertOptions(
            column_types=dict.fromkeys(COLUMNS, pa.int32()), null_values=[]
        ),
    }
    console = Console(stderr=True)
    try:
        with (
            path.open("rb") as raw,
            wrap_file(
                raw,
                path.stat().st_size,
                description=f"reading {path.name}",
                console=console,
                transient=True,
                disable=not console.is_terminal,
            ) as file,
            pa.csv.open_csv(file, **settings) as batches,
        ):
            for batch in batches:
                if batch.num_rows:
                    yield np.column_stack([column.to_numpy() for column in batch.columns])
    except pa.ArrowException as error:
        raise format_error(path, _words(error)) from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error


def _words(error: Exception) -> str:
    """Return what is wrong with a line that pyarrow cannot parse."""
    text = " ".join(str(error).split())
    if found := re.search(r"column #(\d+): Row #(\d+): .*invalid value ('.*')", text):
        column, line, value = found.groups()
        return f"line {line} has {value} for {COLUMNS[int(column)]}, not a whole number"
    if found := re.search(r"Row #(\d+): Expected \d+ columns, got (\d+)", text):
        return f"line {found[1]} has {found[2]} columns, not {len(COLUMNS)}, as if cut off"
    return text


def _check_header(path: Path) -> None:
    with path.open("rb") as file:
        text = file.readline(1 << 16).decode("utf-8-sig", errors="replace")
    # The published names have a leading blank.
    names = [name.strip() for name in text.split(",")]
    if len(names) != len(COLUMNS):
        wrong = f"its first line has {len(names)} columns, not the {len(COLUMNS)}"
        raise format_error(path, f"{wrong} subject, variant, gesture, frame, ch1 ... ch64")
    for number, (name, needed) in enumerate(zip(names, COLUMNS, strict=True), start=1):
        if name != needed:
            raise format_error(path, f"column {number} is called {name!r} instead of {needed!r}")
    if not text.endswith("\n"):
        raise format_error(path, "it has no rows")


def _check(path: Path, rows: np.ndarray, known: int, line: int) -> None:
    """Refuse values out of range, and frames that do not run 1, 2, 3, ... within one capture.

    Args:
        path: for the message.
        rows: (R, 68).
        known: number of rows that have been checked before.
        line: number of the first unchecked row's line.
    """
    new = rows[known:]
    for name, largest in _LARGEST.items():
        values = new[:, COLUMNS.index(name)]
        _refuse_first(path, (values < 1) | (values > largest), line, f"{name} is not 1 to {largest}")
    counts = new[:, _HEAD:]
    wild = (counts.min(axis=1) < 0) | (counts.max(axis=1) > FULL)
    _refuse_first(path, wild, line, f"a channel is not within 0 to {FULL}")
    before = rows[known - 1 : -1] if known else np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    same = (new[:, :_FRAME] == before[:, :_FRAME]).all(axis=1)
    follows = same & (before[:, _FRAME] > 0) & (new[:, _FRAME] == before[:, _FRAME] + 1)
    broken = ~follows & (new[:, _FRAME] != 1)
    _refuse_first(path, broken, line, "frame neither is 1 nor follows that of the line before")


def _refuse_first(path: Path, bad: np.ndarray, line: int, wrong: str) -> None:
    if bad.any():
        raise format_error(path, f"in line {line + int(bad.argmax())} {wrong}")


def _resampled(path: Path, rows: np.ndarray, window: int, line: int) -> Captures:
    """Return whole captures from their rows (R, 68), the first of which stands in ``line``."""
    starts = np.flatnonzero(rows[:, _FRAME] == 1)
    lengths = np.diff(starts, append=len(rows))
    if (lengths < 2).any():
        at = line + int(starts[(lengths < 2).argmax()])
        raise format_error(path, f"the capture in line {at} has one frame, at least 2 make a movement")
    times = np.linspace(0, 1, window) * (lengths[:, None] - 1)
    before = np.minimum(times.astype(int), lengths[:, None] - 2)
    share = (times - before)[..., None].astype(np.float32)
    frame = starts[:, None] + before
    counts = rows[:, _HEAD:].astype(np.float32)
    smooth = counts[frame] * (1 - share) + counts[frame + 1] * share
    subject, variant, gesture = rows[starts, :_FRAME].T
    return Captures(smooth, subject, variant, gesture, lengths.astype(np.int32))
