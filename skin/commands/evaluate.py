"""Evaluate a trained run on other touches, or on a skin.

    skin evaluate run=latest device.seed=7
    skin evaluate run=latest device=serial device.port=/dev/ttyACM0

Writes evaluation_<device>_<id>.md and .png into out=, and an MLflow run of its own with that id.
"""

from skin.commands._command import command
from skin.core.files import results
from skin.runs.configuration import Config, overrides

# Expected seconds of each step, for the fraction in the progress.
_STEPS = {
    "loading the run and the threshold of its alarm": 20.0,
    "reading or simulating the touches": 10.0,
    "evaluating them": 30.0,
}


@command("evaluate")
def main(config: Config, run: str, out: str | None) -> None:
    """Restore a finished run, evaluate it, and print and log the metrics."""
    from skin.core.messages import quiet
    from skin.core.progress import Steps
    from skin.core.settings import option_name
    from skin.evaluation.report import evaluate, print_report, publish_evaluation, write_probabilities
    from skin.evaluation.settings import check_evaluation
    from skin.runs.build import load_model
    from skin.runs.run import find_run
    from skin.runs.store import Store
    from skin.runs.train import log_report

    quiet()
    changes = overrides()
    with Steps(_STEPS) as steps:
        finished = find_run(config.tracking, run, config.trust)
        configured = finished.configured(changes)
        settings, model = check_evaluation(configured.evaluation), load_model(finished, configured)
        device, learner, point = model.device, model.learner, model.point
        steps.begin("reading or simulating the touches")
        if device.real:
            steps.stop()  # a person may be prompted
        touches = device.touches("test")  # read before anything is logged, because a port may fail
        steps.start()
        steps.begin("evaluating them")
        title = f"{finished.title} ({finished.identity})"
        tags = {"evaluated": finished.identity, "overrides": " ".join(changes)}
        store = Store.open(configured.tracking)
        with store.run(f"evaluation of {finished.title}", tags, finished.identity) as evaluation:
            # Evaluations do not overwrite each other's files.
            path = results(out) / f"evaluation_{option_name(device)}_{evaluation.info.run_id[:8]}.md"
            if touches.labels is None:
                written = [path.with_suffix(".csv")]
                probabilities = learner.probabilities(touches)
                print(title, write_probabilities(probabilities, device.task, point, *written), sep="\n")
            else:
                report = evaluate(learner, device, settings, point)
                log_report(store, evaluation, report, device.task, {})
                words = f"`{' '.join(changes)}`" if changes else "the settings of the run"
                description = f"Run {title}, evaluated with {words}, {len(report.predictions)} gestures."
                written = publish_evaluation(path, report, device.task, finished.title, description)
                print_report(report, title)
            for file in written:
                store.client.log_artifact(evaluation.info.run_id, str(file))
    print(*written, sep="\n")
