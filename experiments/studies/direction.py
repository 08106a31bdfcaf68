"""What friction and tilted sensors add to the direction of sliding."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev

from hydra import compose
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from skin.config import checked, fingerprint
from skin.files import write
from skin.run import train
from skin.tracking import Store
from studies.moving_runs import children_of
from studies.settings import DirectionSettings
from studies.study import paired, verdict
from studies.table import markdown

__all__ = ["Line", "comparison", "publish", "train_lines"]

_HEAD = ("row", "skin", "degrees", "within 45", "labels", "difference", "seeds", "verdict")
_OWN = ("direction.", "out=", "simulator=")
_ABOUT = """
Degrees: mean size of the angle between the direction that is said and the true one, from the first place of a
touch to its last, over the 4000 test gestures' touches that slide and do not go to and fro; a blind guess has
90. Within 45: per cent of them up to 45 degrees; a blind guess has 25. Labels: overall accuracy of the other
four, per cent. Mean and deviation over seeds. Difference in degrees from the row's first skin, mean and
standard error over the same seeds; "better" or "worse" only beyond two standard errors over three or more.
"""


@dataclass(frozen=True)
class Line:
    """What one row gave on one skin: metric -> seed -> value."""

    row: str
    skin: str
    found: Mapping[str, Mapping[str, float]]

    def cell(self, metric: str, unit: float = 1.0) -> str:
        """Mean and deviation."""
        values = [unit * value for value in self.found[metric].values()]
        return f"{fmean(values):.1f}" + (f" ± {stdev(values):.1f}" if len(values) > 1 else "")


def train_lines(overrides: Sequence[str], settings: DirectionSettings) -> list[Line]:
    """Train every row on every skin; what a finished run did before is not repeated.

    Args:
        overrides: of the command line; those of this command alone are left aside.
        settings: what is compared.
    """
    own = [one for one in overrides if not one.lstrip("+~").startswith(_OWN)]
    common = ["simulator=solid", "data.direction=true", "evaluation.devices=0", "evaluation.layouts=0"]
    configs: dict[tuple[str, str, str], DictConfig] = {
        (row, skin, str(seed)): checked(
            compose(
                "train", [f"experiment={row}", *common, *own, *given, f"row=direction_{skin}", f"seed={seed}"]
            )
        )
        for seed in settings.seeds
        for row in settings.rows
        for skin, given in settings.skins.items()
    }
    store = Store.open(next(iter(configs.values())).tracking)
    todo = [one for one in configs.values() if not store.find("FINISHED", fingerprint=fingerprint(one))]
    if todo:
        with store.run("direction", {"sweep": "direction"}) as parent, children_of(parent):
            for config in track(todo, "training", console=Console(stderr=True)):
                train(config)
    found: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    for (row, skin, seed), config in configs.items():
        metrics = store.find("FINISHED", fingerprint=fingerprint(config))[0].data.metrics
        for name in _METRICS:
            found.setdefault((row, skin), {}).setdefault(name, {})[seed] = metrics[f"same/{name}"]
    return [Line(row, skin, found[row, skin]) for row in settings.rows for skin in settings.skins]


_METRICS = ("direction/degrees", "direction/accuracy", "overall/accuracy")


def comparison(lines: Sequence[Line]) -> list[dict[str, str]]:
    """Return a line for a person of each, with its difference from the row's first skin."""
    told, first = [], dict[str, Line]()
    for one in lines:
        base = first.setdefault(one.row, one)
        degrees = one.found[_METRICS[0]]
        found = None if one is base else paired(degrees, base.found[_METRICS[0]])
        words = {"agree": "better", "disagree": "worse", "undecided": "undecided"}
        values = (
            one.row,
            one.skin,
            one.cell(_METRICS[0]),
            one.cell(_METRICS[1], 100),
            one.cell(_METRICS[2], 100),
            "" if found is None else f"{found.mean:+.1f} ± {found.error:.1f}",
            str(len(degrees)),
            "" if one is base else words[verdict("less", found)],
        )
        told.append(dict(zip(_HEAD, values, strict=True)))
    return told


def publish(folder: Path, told: Sequence[dict[str, str]]) -> None:
    """Write ``direction.md`` and ``direction.csv`` whole, and print what they hold."""
    table = [list(_HEAD), *([line[name] for name in _HEAD] for line in told)]
    write(markdown(table, "Direction of sliding") + _ABOUT, folder / "direction.md")
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(table)
    write(buffer.getvalue(), folder / "direction.csv")
    shown = Table(*_HEAD, box=None, pad_edge=False)
    for line in table[1:]:
        shown.add_row(*line)
    console = Console()
    # A number cut short would be another number: rather let a narrow terminal wrap.
    console.width = max(
        console.width, console.measure(shown, options=console.options.update(width=200)).maximum
    )
    console.print(shown)
    print(f"{folder / 'direction.md'} and {folder / 'direction.csv'}")
