"""Write simulated touches to a Parquet or CSV file.

    skin generate n=1000 out=touches.parquet

Prints a summary of the touches, and warns if the shape alone predicts a label.
"""

from omegaconf import DictConfig

from skin.command import command
from skin.config import fingerprint, plain
from skin.errors import InputError


@command("generate")
def main(config: DictConfig) -> None:
    """Draw a budget of n gestures and write readings, labels and parameters."""
    if config.out is None:
        raise InputError("out is missing: add out=touches.parquet or out=touches.csv")
    if not config.out.endswith((".parquet", ".csv")):
        raise InputError(f"a recording is a .parquet or .csv file, got {config.out}: add out=touches.parquet")

    from dataclasses import replace

    from omegaconf import OmegaConf

    from skin.build import build_device
    from skin.class_balance import report_balance
    from skin.recording_file import write_recording
    from skin.summary import summary_line

    device = build_device(config)
    recording = device.recording()
    report_balance(device, recording)
    # The path of the file does not change the touches.
    source = OmegaConf.masked_copy(config, [str(key) for key in config if key != "out"])
    about = {"config_hash": fingerprint(source), "config": plain(source)}
    path = write_recording(replace(recording, metadata=recording.metadata | about), config.out)
    # The metadata of a file may have any content.
    known = device.simulation is not None
    text = summary_line(recording.metadata["summary"]) if known else f"{len(recording)} gestures"
    print(f"{path}: {text}")
