"""Arguments that commands over many runs share: simulators, seeds, overrides; and their error messages."""

import argparse
import sys
from collections.abc import Callable
from functools import wraps

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from skin.config import CONF, checked
from skin.refusal import refusal

__all__ = ["configuration", "jobs", "names", "parser", "refusing"]


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser of ``--simulators``, ``--seeds`` and overrides."""
    made = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--simulators", type=names, default=["fem"], metavar="naive,fem")
    made.add_argument("--seeds", type=_count, default=1, metavar="N", help="seeds 0, 1, ... N - 1")
    made.add_argument("overrides", nargs="*", help="of the configuration, as in device.noise=0.1")
    return made


def jobs(arguments: argparse.Namespace) -> list[list[str]]:
    """Return the overrides of every simulator and seed."""
    return [
        [*arguments.overrides, f"simulator={simulator}", f"seed={seed}"]
        for simulator in arguments.simulators
        for seed in range(arguments.seeds)
    ]


def configuration(*overrides: str) -> DictConfig:
    """Return the configuration of a training with overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(compose("train", list(overrides)))


def names(text: str) -> list[str]:
    """Return the names in a list with commas."""
    return [name for name in text.split(",") if name]


def refusing(main: Callable[[], None]) -> Callable[[], None]:
    """Make bad input end a command with one sentence and exit code 2."""

    @wraps(main)
    def refuse() -> None:
        try:
            main()
        except Exception as error:
            refused = refusal(error)
            if refused is None:
                raise
            print(refused, file=sys.stderr)
            sys.exit(2)

    return refuse


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no number of seeds: give 1 or more")
    return int(text)
