"""Try finished runs on windows that slide over streams of touches: python experiments/stream.py run=latest

rows=all takes the newest finished runs of every row on simulator=, on whole touches and on windows of streams
(skin train data.stream=true) each. Earlier results are read from MLflow.
"""

from skin.command import command
from skin.config import DictConfig, overrides, plain
from skin.evaluation.course import Course
from skin.files import results


@command("stream")
def main(config: DictConfig) -> None:
    """Slide a window over streams for each run; print a line, write its files, log both beside the run."""
    course = Course(**plain(config)["stream"])

    from skin.console import quiet
    from skin.reload import find
    from skin.tracking import Store
    from studies.sliding_runs import newest, try_run

    quiet()
    store = Store.open(config.tracking)
    runs = newest(store, config.data.name, config.rows) if config.rows else [find(store, config.run)]
    given = overrides()
    for run in runs:
        print(try_run(store, run, config, course, given, results(config.out)), flush=True)


if __name__ == "__main__":
    main()
