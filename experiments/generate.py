"""Write simulated touches to a file: python experiments/generate.py n=1000 out=touches.parquet"""

from omegaconf import DictConfig, OmegaConf

from skin.config import command


@command("generate")
def main(config: DictConfig) -> None:
    """Draw a budget of n gestures and write all that is known about them."""
    from dataclasses import replace
    from pathlib import Path

    from skin.build import build_device
    from skin.config import fingerprint, plain
    from skin.errors import InputError
    from skin.storage import check_suffix, write
    from skin.summary import line

    if config.out is None:
        raise InputError("where to? add out=touches.parquet or out=touches.csv")
    check_suffix(Path(config.out))
    recording = build_device(config).recording()
    # Where the touches go does not change them.
    source = OmegaConf.masked_copy(config, [key for key in config if key != "out"])
    about = {"config_hash": fingerprint(source), "config": plain(source)}
    path = write(replace(recording, metadata=recording.metadata | about), config.out)
    print(f"{path}: {line(recording.metadata['summary'])}")


if __name__ == "__main__":
    main()
