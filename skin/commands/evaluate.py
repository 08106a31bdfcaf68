"""Evaluate a trained run on other touches, or on a skin.

    skin evaluate run=latest device.seed=7
    skin evaluate run=latest device=serial device.port=/dev/ttyACM0

Writes evaluation_<device>_<id>.md and .png into out=, and an MLflow run of its own with that id.
"""

from skin.commands._command import command
from skin.runs.configuration import Config, overrides


@command("evaluate")
def main(config: Config, run: str, out: str | None) -> None:
    """Restore a finished run, evaluate it, and print and log the metrics."""
    from skin.runs.train import evaluate_run

    evaluate_run(config, run, out, overrides())
