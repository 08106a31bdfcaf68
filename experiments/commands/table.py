"""Train every row of the results table, or what is missing of it, and print it beside the report's numbers.

    skin table
    skin table table.seeds=3 table.simulators=[solid]

Lets the rows of the report decide together, too. Writes table.md, table.csv, table_seeds.csv and
the figures of the report into out=; rerun to resume.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge
from omegaconf import DictConfig

from skin.command import command
from skin.config import overrides, plain
from skin.files import results
from skin.paths import ROOT
from skin.settings import check_settings

_TITLE = "Accuracy on the test gestures in per cent (the report's in brackets)"
_SMOKE = "SMOKE, one epoch on little data, ignore the scores: "


@command("table")
def main(config: DictConfig) -> None:
    """Run the sweep, then write the results of finished runs; exit code 1 if one is missing."""
    settings = plain(config)["table"]
    check_settings(sweep, settings, "table")
    words = sweep(**settings)
    words += [one for one in overrides() if not one.startswith(("table.", "out="))]

    from experiments.studies.runs import multirun
    from skin.console import quiet

    quiet()
    code = multirun(words)
    if config.shard is not None:
        print(f"shard {config.shard} is done: the same command without shard= writes the table")
        sys.exit(code)
    budget = settings["budget"]
    folder = results(config.out) / ("" if budget == "full" else budget)
    sys.exit(1 if write_results(words, budget, folder) else 0)


def sweep(
    budget: Literal["full", "smoke"], seeds: Annotated[int, Ge(1)], simulators: Sequence[str] | None = None
) -> list[str]:
    """Return the overrides of the sweep that trains the table."""
    words = [f"sweep={'table' if budget == 'full' else budget}", f"seed={','.join(map(str, range(seeds)))}"]
    return words + ([f"simulator={','.join(simulators)}"] if simulators else [])


def write_results(words: Sequence[str], budget: str, folder: Path) -> int:
    """Write and print the results of finished runs and their budget; return the number of missing runs."""
    from experiments.studies.report_figures import draw_runs, draw_skin
    from experiments.studies.results_table import (
        collect,
        display_rows,
        print_results,
        report_values,
        result_rows,
        results_csv,
        seeds_csv,
    )
    from experiments.studies.table_rows import Entries
    from experiments.studies.tables import markdown
    from skin.build import build_device
    from skin.files import write
    from skin.run import simulator
    from skin.tracking import Store

    entries = Entries(words)
    store = Store.open(entries.rows[0].tracking)
    entries.vote(store)
    cells = collect(store, entries.named(entries.rows))
    cells += [cell for cell in collect(store, entries.named(entries.others)) if cell.runs]
    skins = {simulator(config): config for config in reversed(entries.rows)}
    simulators = list(reversed(skins))
    cells.sort(key=lambda cell: simulators.index(cell.simulator))
    lines = result_rows(cells, report_values(ROOT / "data" / "report_table.csv"), budget)
    title = _TITLE if budget == "full" else _SMOKE + _TITLE
    paths = [
        write(markdown(display_rows(lines), title), folder / "table.md"),
        write(results_csv(lines), folder / "table.csv"),
        write(seeds_csv(cells), folder / "table_seeds.csv"),
    ]
    name = "fem" if "fem" in skins else simulators[-1]
    device = build_device(skins[name]).simulated("the figures of the report are of a simulated skin")
    pictures = [*draw_runs(cells, store, folder, skins), *draw_skin(device, folder, name)]
    print_results(lines, title)
    print(f"{', '.join(map(str, paths))} and {len(pictures)} figures beside them")
    return sum(cell.missing for cell in cells)
