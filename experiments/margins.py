"""How far from a threshold a verdict can be trusted: python experiments/margins.py run=latest

Sorts the verdicts of a finished run by area, travel, duration and pressure over their thresholds, and by the
highest reading. Writes margins_<row>_<id>.md, .csv and .png into out=, and the MLflow
run that has this id.
"""

from skin.command import command
from skin.config import DictConfig, overrides
from skin.errors import InputError
from skin.files import results

_OWN = ("gestures", "out", "run")


@command("margins")
def main(config: DictConfig) -> None:
    """Bring a finished run back, sort its verdicts, print a line, write its files and log them."""
    if config.gestures < 1:
        raise InputError(f"margins need touches, got gestures={config.gestures}: as in gestures=20000")

    from skin.build import build_data, build_device, build_learner
    from skin.console import quiet
    from skin.evaluation.margins import margins
    from skin.reload import changed, configuration, find, operating_point, restore
    from skin.tracking import Store
    from studies.margins import line, publish

    quiet()
    store, folder = Store.open(config.tracking), results(config.out)
    run = find(store, config.run)
    given = [one for one in overrides() if one.lstrip("+~").split("=")[0] not in _OWN]
    stored = configuration(store, run, config.trust)
    own = changed(stored, config, given)
    device, learner = build_device(own), build_learner(own)
    restore(store, run, learner, build_data(own, device))
    point = operating_point(run, learner, stored, own.evaluation)
    found = margins(learner, device, config.gestures, point)
    tags = {"evaluated": run.info.run_id, "overrides": " ".join(given)}
    with store.run(f"margins of {run.info.run_name}", tags, run.info.run_id) as logged:
        title = f"{run.info.run_name}, run {run.info.run_id[:8]}, {config.gestures} touches"
        written = publish(found, title, folder / f"margins_{own.row}_{logged.info.run_id[:8]}")
        for path in written:
            store.client.log_artifact(logged.info.run_id, str(path))
    print(line(found), *written, sep="\n")


if __name__ == "__main__":
    main()
