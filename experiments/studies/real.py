"""Learn place, force, gestures and an alarm on real recordings, and test on others.

    python -m experiments.studies.real data=FOLDER                   # recordings of others, docs/real.md
    python -m experiments.studies.real data=FOLDER share=0.1         # a tenth of the presses
    python -m experiments.studies.real data=FOLDER rows=epi,sdu      # beginnings of rows; others stay

Writes real.csv to the folder out=, results by default. The estimator of each row is chosen by
cross-validation on the training touches alone: sessions, blocks of time or places are held out.
"""

import csv
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from experiments import run_script
from experiments.studies import real_barometers, real_epi, real_presses
from experiments.studies.pages import csv_text
from experiments.studies.real_rows import RealSettings
from skin.core.files import write
from skin.core.settings import configured
from skin.errors import InputError

ROWS = (*real_presses.ROWS, *real_epi.ROWS, *real_barometers.ROWS)


def measure_rows(settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Yield the lines of all rows whose recordings are in the folder."""
    chosen = [row for row in ROWS if row.name.startswith(tuple(settings.rows.split(",")))]
    if not chosen:
        raise InputError(f"rows={settings.rows} begins no row: {', '.join(row.name for row in ROWS)}")
    folder = Path(settings.data).expanduser()
    present = [row for row in chosen if (folder / row.path).exists()]
    if not present:
        raise InputError(
            f"data={settings.data} holds none of {', '.join(sorted({row.path for row in chosen}))}"
        )
    for path in sorted({row.path for row in chosen} - {row.path for row in present}):
        print(f"left out, no such file or folder: {folder / path}", file=sys.stderr)
    for row in present:
        yield from row.run(row, row.read(row, folder / row.path, settings), settings)


def write_lines(lines: Iterator[dict[str, Any]], path: Path) -> None:
    """Print lines as they come, and write them as CSV, rounded to three digits; other rows stay in it."""
    order = [row.name for row in ROWS]
    whole = list[dict[str, Any]]()
    for values in lines:
        rounded = {
            name: round(value, 3) if isinstance(value, float) else value for name, value in values.items()
        }
        print(*rounded.values(), sep=", ", flush=True)
        whole.append(rounded)
    names = {values["row"] for values in whole}
    if path.is_file():
        with path.open(encoding="utf-8") as file:
            whole += [values for values in csv.DictReader(file) if values["row"] in {*order} - names]
    whole.sort(key=lambda values: order.index(values["row"]))
    print(write(csv_text([[*whole[0]], *([values[name] for name in whole[0]] for values in whole)]), path))


def main(words: Sequence[str]) -> None:
    """Run what the words ``name=value`` select."""
    entries = OmegaConf.to_container(OmegaConf.from_dotlist(list(words)))
    settings = configured(RealSettings, entries, "real")  # type: ignore[arg-type]
    write_lines(measure_rows(settings), Path(settings.out) / "real.csv")


if __name__ == "__main__":
    run_script(main)
