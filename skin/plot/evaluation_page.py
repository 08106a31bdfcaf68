"""An evaluation as a page with confusion matrices; verdicts of touches without labels."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from torch import Tensor

from skin.evaluation.metrics_table import format_number
from skin.evaluation.operating_point import LABEL, OperatingPoint
from skin.evaluation.report import SHARES, Report
from skin.files import whole, write
from skin.labels import Task
from skin.plot.figures import confusions, save_figure


def evaluation_markdown(found: Report, task: Task, title: str, about: str) -> str:
    """Return a page in Markdown: accuracies in per cent, and how often each label was taken for what.

    Args:
        found: what an evaluation found.
        task: the labels.
        title: of the page.
        about: a sentence on where the touches came from.
    """
    columns = list(dict.fromkeys(name.split("/")[0] for name in found.metrics))
    lines = [f"# {title}", "", about, "", "Per cent:", "", f"| | {' | '.join(columns)} |"]
    lines.append("|---" * (len(columns) + 1) + "|")
    rows = dict.fromkeys(name.split("/", 1)[1] for name in found.metrics)
    for row in rows:
        if row.endswith(SHARES):
            shares = (found.metrics.get(f"{column}/{row}") for column in columns)
            lines.append(f"| {row} | {' | '.join(map(format_number, shares))} |")
        if row.endswith("/degrees"):
            sizes = (found.metrics.get(f"{column}/{row}") for column in columns)
            lines.append(
                f"| {row} | {' | '.join(format_number(x, 1) + '°' * (x is not None) for x in sizes)} |"
            )
    if found.point is not None and found.reached is not None:
        lines += ["", f"{found.point.sentence()}; {found.reached.sentence()}."]
    lines += [f"\n{column}: {reason}" for column, reason in found.cannot.items()]
    if found.confusion is not None:
        lines += [
            "",
            "| label | no, said no | no, said yes | yes, said no | yes, said yes |",
            "|---" * 5 + "|",
        ]
        for name, counts in zip(task.binary, found.confusion.numpy().astype(int), strict=True):
            lines.append(f"| {name} | {' | '.join(map(str, counts.ravel().tolist()))} |")
    return "\n".join(lines) + "\n"


def publish_evaluation(path: Path, found: Report, task: Task, title: str, about: str) -> list[Path]:
    """Write ``path`` (.md), and the confusion matrices beside it (.png), each whole."""
    written = [write(evaluation_markdown(found, task, title, about), path)]
    if found.confusion is not None:
        named = dict(zip(task.binary, found.confusion.numpy(), strict=True))
        written.append(save_figure(confusions(named, ("no", "yes")), path.with_suffix(".png")))
    return written


def verdicts(chances: Tensor, task: Task, point: OperatingPoint | None, path: Path) -> tuple[str, Path]:
    """Write the probability of each label, gesture by gesture, where nobody knows the truth.

    Args:
        chances: (B, L); of a direction the mean cosines.
        task: the labels.
        point: where the alarm is raised; a gesture is said to be dangerous there, as ``live`` says it.
        path: x.csv.

    Returns:
        lines for a person, and the path.
    """
    columns = {f"p_{name}": values.numpy() for name, values in zip(task.names, chances.T, strict=True)}
    table = pa.table({"gesture": np.arange(len(chances)), **columns})
    with whole(path) as partial:
        pa.csv.write_csv(table, partial)
    levels = dict.fromkeys(task.binary, 0.5) | ({} if point is None else {LABEL: point.threshold})
    said = [
        f"gesture {number}: "
        + ", ".join(
            f"{'' if chance > levels[name] else 'not '}{name} ({chance:.2f})"
            for name, chance in zip(task.binary, row, strict=False)
        )
        + (_slide(row, task) if task.direction else "")
        for number, row in enumerate(chances.tolist())
    ]
    return "\n".join(said), path


def _slide(row: Sequence[float], task: Task) -> str:
    """Return where a touch slides that is said to be dynamic: 0° along x, 90° along y."""
    if row[task.names.index("dynamic")] <= 0.5:
        return ""
    return f", sliding towards {math.degrees(math.atan2(row[-1], row[-2])):.0f}°"
