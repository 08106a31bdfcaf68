"""Evaluate a trained run on other touches, or on a skin.

    skin evaluate run=latest device.seed=7
    skin evaluate run=latest device=serial device.port=/dev/ttyACM0

Writes evaluation_<device>_<id>.md and .png into out=, and an MLflow run of its own with that id.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hydra import compose

from skin.commands._command import command
from skin.core.files import results
from skin.errors import InputError
from skin.runs.configuration import Config, overrides

if TYPE_CHECKING:
    from skin.core.messages import Steps


# Expected seconds of each step, for the share in the progress.
_STEPS = {
    "loading the run and the threshold of its alarm": 20.0,
    "reading or simulating the touches": 10.0,
    "evaluating them": 30.0,
}


@command("evaluate")
def main(config: Config) -> None:
    """Restore a finished run, evaluate it, and print and log the metrics."""
    from skin.core.messages import Steps

    with Steps(_STEPS) as steps:
        _evaluate(config, steps)


def _evaluate(config: Config, steps: "Steps") -> None:
    from skin.core.messages import quiet
    from skin.core.settings import option_name
    from skin.evaluation.report import evaluate, print_report, publish_evaluation, write_chances
    from skin.evaluation.settings import check_evaluation
    from skin.runs.finished_run import FinishedRun
    from skin.runs.model_of_run import load_model
    from skin.runs.store import Store
    from skin.runs.train import log_report

    quiet()
    run, folder, changes = FinishedRun.named(config), results(config.out), overrides()
    config = run.configured(compose("evaluate", changes), changes)
    settings = check_evaluation(config.evaluation)
    if "skins" in config.device and settings.profile is not None:
        raise InputError("evaluation.profile chooses the threshold for one skin: add device=simulated")
    model = load_model(run, config)
    device, learner, point = model.device, model.learner, model.point
    steps.begin("reading or simulating the touches")
    steps.silent = device.real
    touches = device.touches("test")  # read before anything is logged, because a port may fail
    steps.silent = False
    steps.begin("evaluating them")
    title = f"{run.title} ({run.identity})"
    tags = {"evaluated": run.identity, "overrides": " ".join(changes)}
    store = Store.open(config.tracking)
    with store.run(f"evaluation of {run.title}", tags, run.identity) as evaluation:
        # Evaluations do not overwrite each other's files.
        name = f"evaluation_{option_name(device)}_{evaluation.info.run_id[:8]}"
        if touches.labels is None:
            chances = learner.probabilities(touches)
            text, path = write_chances(chances, device.task, point, folder / f"{name}.csv")
            store.client.log_artifact(evaluation.info.run_id, str(path))
            print(f"{title}\n{text}\n{path}")
            return
        report = evaluate(learner, device, settings, point)
        log_report(store, evaluation, report, device.task, {})
        about = describe_evaluation(title, changes, len(report.predictions))
        written = publish_evaluation(folder / f"{name}.md", report, device.task, run.title, about)
        for path in written:
            store.client.log_artifact(evaluation.info.run_id, str(path))
    print_report(report, title)
    print(*written, sep="\n")


def describe_evaluation(title: str, changes: Sequence[str], count: int) -> str:
    """Return a sentence about an evaluation of ``count`` gestures.

    Args:
        title: of the run.
        changes: the overrides; none keep the settings of the run.
        count: number of gestures.
    """
    settings = f"`{' '.join(changes)}`" if changes else "the settings of the run"
    return f"Run {title}, evaluated with {settings}, {count} gestures."
