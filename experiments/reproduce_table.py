"""Train every row of the table, or what is missing of it, and print it beside the report's numbers."""

import argparse
import sys
from pathlib import Path

import train
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from skin.config import CONF, ROOT, checked
from skin.sweep import jobs

BUDGETS = {"full": "table", "smoke": "smoke"}


def main() -> None:
    """Run the sweep, then write table and figures to ``results/``; exit code 1 if a run failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget", choices=BUDGETS, default="full")
    parser.add_argument("--seeds", type=_count, default=1, help="runs per row: seeds 0, 1, ...")
    arguments = parser.parse_args()
    overrides = [f"sweep={BUDGETS[arguments.budget]}", "seed=" + ",".join(map(str, range(arguments.seeds)))]
    code = _sweep(["-m", *overrides])
    missing = report(overrides, ROOT / "results" / ("" if arguments.budget == "full" else arguments.budget))
    sys.exit(code or (1 if missing else 0))


def report(overrides: list[str], folder: Path) -> int:
    """Write and print what finished runs say; return how many are missing."""
    from skin.build import build_device
    from skin.results.gallery import draw_runs, draw_skin
    from skin.results.show import results
    from skin.results.table import as_csv, collect, grid, markdown, report_values, rows, write
    from skin.tracking import Store

    parameters = OmegaConf.load(CONF / "sweep" / "table.yaml").hydra.sweeper.params
    with initialize_config_dir(str(CONF), version_base="1.3"):
        configs = [
            checked(compose("train", [f"{key}={value}" for key, value in job.items()]))
            for job in jobs(overrides, parameters)
        ]
    store = Store.open(configs[0].tracking)
    cells = collect(store, ((config.row, config.data.name, config) for config in configs))
    lines = rows(cells, report_values(ROOT / "data" / "report_table.csv"))
    write(as_csv(lines), folder / "table.csv")
    title = "Accuracy on the test gestures in per cent (the report's in brackets)"
    write(markdown(grid(lines), title), folder / "table.md")
    skin = next(config for config in configs if config.data.name == "fem")
    pictures = [*draw_runs(cells, store, folder), *draw_skin(build_device(skin), folder)]
    results(lines, title)
    print(f"{folder / 'table.md'}, {folder / 'table.csv'} and {len(pictures)} figures beside them")
    return sum(cell.missing for cell in cells)


def _sweep(arguments: list[str]) -> int:
    """Run ``train.py`` with arguments, in this process, and return its exit code."""
    sys.argv = [str(Path(train.__file__)), *arguments]
    try:
        train.main()
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    return 0


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no number of seeds: give 1 or more")
    return int(text)


if __name__ == "__main__":
    main()
