"""Adapt a finished run of a network to a skin with few labelled gestures.

    skin adapt run=latest device=recording device.path=session.parquet
    skin adapt run=latest device=serial device.port=/dev/ttyACM0 device.labels=prompted adapt.gestures=48

The gestures are recorded (skin record, or skin generate for simulated ones) or read from a port. body= and
layout= describe the skin if the run has another one. Logs a new run, which keeps the weights if fine-tuning
is not better on held-out gestures.
"""

from skin.commands._command import command
from skin.runs.configuration import Config, overrides


@command("adapt")
def main(config: Config, run: str) -> None:
    """Fine-tune a run, log the result, and print the figures before and after."""
    from skin.core.messages import quiet
    from skin.runs.adaptation import adapt

    quiet()
    adapt(config, run, overrides())
