"""The table of moving and misplaced sensors."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from skin.files import write
from studies.moving import Change
from studies.moving_runs import Trial
from studies.study import Paired, paired, verdict
from studies.table import markdown

__all__ = ["comparison", "publish"]

_HEAD = ("row", "condition", "accuracy", "difference", "seeds", "verdict")
_ABOUT = """
Accuracy: overall, per cent, mean and deviation over the seeds. Difference: from the row's first line, mean
and standard error over the same seeds; "better" or "worse" only beyond two standard errors over three seeds
or more. Seeds are of devices (gains, offsets, noise, places, moduli) for finished runs, and of trainings for
moving_*.
"""


def comparison(trials: Sequence[Trial]) -> list[dict[str, str]]:
    """Return a line per trial: its accuracy, and its difference from the row's first trial over seeds."""
    lines, first = [], dict[str, Trial]()
    for one in trials:
        base = first.setdefault(one.row, one)
        found = None if one is base else paired(one.accuracy, base.accuracy)
        lines.append(
            {
                "row": one.row,
                "condition": one.condition,
                "accuracy": one.cell,
                "difference": "" if found is None else f"{found.mean:+.2f} ± {found.error:.2f}",
                "seeds": str(len(one.accuracy)),
                "verdict": "" if one is base else _effect(found),
            }
        )
    return lines


def _effect(found: Paired | None) -> str:
    """Return whether a difference passes two standard errors over at least three seeds, and which way."""
    words = {"agree": "better", "disagree": "worse", "undecided": "undecided"}
    return words[verdict("greater", found)]


def publish(folder: Path, moves: Change, count: int, lines: Sequence[dict[str, str]]) -> None:
    """Write ``moving.md`` and ``moving.csv`` whole, and print what they hold.

    Args:
        folder: where to.
        moves: how far sensors move.
        count: in how many gestures.
        lines: as :func:`comparison` gives them.
    """
    about = [
        "# Moving and misplaced sensors",
        "",
        f"Over {count} gestures {moves.sentence}.",
        "",
        _motion(moves),
    ]
    table = [list(_HEAD), *([line[name] for name in _HEAD] for line in lines)]
    text = "\n".join(about) + "\n"
    if lines:
        text += "\n" + markdown(table, "Accuracy").replace("# Accuracy", "## Accuracy") + _ABOUT
    write(text, folder / "moving.md")
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, _HEAD, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    write(buffer.getvalue(), folder / "moving.csv")
    print(_motion(moves))
    if lines:
        shown = Table(*_HEAD, box=None, pad_edge=False)
        for line in table[1:]:
            shown.add_row(*line)
        Console().print(shown)
    print(f"{folder / 'moving.md'} and {folder / 'moving.csv'}")


def _motion(moves: Change) -> str:
    x, y, z = (f"{1e3 * value:.2f}" for value in moves.furthest)
    told = ", ".join(f"{value:.0%}" for value in moves.explained)
    return (
        f"Sensors move at most {x} mm along x, {y} mm along y and {z} mm into the skin; a ridge regression "
        f"on the readings explains {told} of that motion's mean square."
    )
