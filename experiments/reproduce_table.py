"""Train every row of the table, or what is missing of it, and print it beside the report's numbers."""

import argparse
import sys

from skin.commands import train
from skin.config import ROOT
from studies.cli import refusing

BUDGETS = {"full": "table", "smoke": "smoke"}
_TITLE = "Accuracy on the test gestures in per cent (the report's in brackets)"
TITLES = {"full": _TITLE, "smoke": f"SMOKE, little data and one epoch, these numbers mean nothing: {_TITLE}"}


@refusing
def main() -> None:
    """Run the sweep, let its rows vote, then write table and figures to ``results/``; 1 if a run failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget", choices=BUDGETS, default="full")
    parser.add_argument("--seeds", type=_count, default=1, help="runs per row: seeds 0, 1, ...")
    parser.add_argument("--simulators", help="such as solid, or naive,fem,solid; default: as the sweep says")
    arguments = parser.parse_args()
    overrides = [f"sweep={BUDGETS[arguments.budget]}", "seed=" + ",".join(map(str, range(arguments.seeds)))]
    overrides += [f"simulator={arguments.simulators}"] if arguments.simulators else []
    code = _sweep(["-m", *overrides])
    missing = report(overrides, arguments.budget)
    sys.exit(code or (1 if missing else 0))


def report(overrides: list[str], budget: str) -> int:
    """Write and print what finished runs say, with their budget; return how many are missing."""
    from skin.build import build_device
    from skin.files import results, write
    from skin.tracking import Store
    from studies.report_figures import draw_runs, draw_skin
    from studies.table import as_csv, collect, grid, markdown, report_values, rows, show
    from studies.table_rows import Entries

    entries = Entries(overrides)
    store = Store.open(entries.rows[0].tracking)
    entries.vote(store)
    cells = collect(store, entries.named(entries.rows))
    cells += [cell for cell in collect(store, entries.named(entries.others)) if cell.runs]
    simulators = list(dict.fromkeys(config.data.name for config in entries.rows))
    cells.sort(key=lambda cell: simulators.index(cell.simulator))
    folder = results(None) / ("" if budget == "full" else budget)
    lines = rows(cells, report_values(ROOT / "data" / "report_table.csv"), budget)
    write(as_csv(lines), folder / "table.csv")
    title = TITLES[budget]
    write(markdown(grid(lines), title), folder / "table.md")
    skin = {config.data.name: config for config in reversed(entries.rows)}
    name = "fem" if "fem" in skin else simulators[-1]
    pictures = [*draw_runs(cells, store, folder), *draw_skin(build_device(skin[name]), folder, name)]
    show(lines, title)
    print(f"{folder / 'table.md'}, {folder / 'table.csv'} and {len(pictures)} figures beside them")
    return sum(cell.missing for cell in cells)


def _sweep(arguments: list[str]) -> int:
    """Run ``skin train`` with arguments, in this process, and return its exit code."""
    try:
        train.main(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    return 0


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no number of seeds: give 1 or more")
    return int(text)


if __name__ == "__main__":
    main()
