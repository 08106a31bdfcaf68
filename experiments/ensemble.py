"""Let the finished rows of a table decide together: python experiments/ensemble.py --seeds 3

By voting (the probability is the share of votes) and by averaged probabilities. Each simulator and seed
becomes two runs, ensemble_vote and ensemble_average; with --rows their names tell of which rows.
"""

from omegaconf import DictConfig

from skin.config import CONF
from skin.errors import InputError
from studies.cli import configuration, jobs, names, parser, refusing

ROWS = ("linked_graph", "temporal_graph", "temporal_image", "sequence_graph", "sequence_image")
WAYS = ("ensemble_vote", "ensemble_average")


@refusing
def main() -> None:
    """Evaluate the ensembles that are missing and print them beside their members."""
    arguments = parser(__doc__)
    arguments.add_argument("--rows", type=names, default=ROWS, help="the report's networks if left out")
    chosen = arguments.parse_intermixed_args()
    for row in chosen.rows:
        if not (CONF / "experiment" / f"{row}.yaml").is_file():
            known = ", ".join(sorted(path.stem for path in (CONF / "experiment").glob("*.yaml")))
            raise InputError(f"there is no row {row}: choose from {known}")
    todo = [configurations(job, chosen.rows) for job in jobs(chosen)]

    from rich.progress import Progress

    from skin.console import quiet
    from skin.tracking import Store
    from studies.ensemble import combine, show

    quiet()
    with Progress(transient=True) as progress:
        task = progress.add_task("", total=len(todo))
        for members, ways in todo:
            title = f"{members[0].data.name}, seed {members[0].seed}"

            def say(doing: str, title: str = title) -> None:
                progress.update(task, description=f"{title}: {doing}")

            show(combine(Store.open(members[0].tracking), members, ways, say), title, progress.console)
            progress.advance(task)


def configurations(
    overrides: list[str], rows: tuple[str, ...] = ROWS
) -> tuple[list[DictConfig], dict[str, DictConfig]]:
    """Return the members' configurations and, for each way, the ensemble's."""
    members = [configuration(f"experiment={row}", *overrides) for row in rows]
    suffix = "" if tuple(rows) == ROWS else "_of_" + "_".join(rows)
    return members, {way: configuration(*overrides, f"row={way}{suffix}") for way in WAYS}


if __name__ == "__main__":
    main()
