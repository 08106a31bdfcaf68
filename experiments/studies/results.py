"""Make every published result again, or what is missing of it.

    skin results
    skin results results.part=table

Writes into docs/results; rerun to resume.
"""

import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import join, split
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt

from experiments import peers
from skin.commands._command import command
from skin.core.settings import check_settings, configured
from skin.errors import InputError
from skin.runs.configuration import Config, overrides

_PEERS = "experiments/peers/conf"
_FRESH = {"uri": "sqlite:///results/fresh.db", "artifacts": "results/fresh"}  # of tracking


@dataclass(frozen=True)
class ResultStep:
    """A command of a part.

    Attributes:
        run: verb and overrides.
        hours: its duration without finished runs.
    """

    run: str
    hours: Annotated[float, Gt(0)]


@dataclass(frozen=True)
class PublishedResults:
    """The settings of ``conf/results.yaml``.

    Raises:
        InputError: a part that there is not.
    """

    part: str
    optional: Sequence[str]
    budget: Literal["full", "smoke"]
    jobs: Annotated[int, Ge(1)]
    fresh: bool
    parts: Mapping[str, Sequence[Mapping[str, Any]]]
    smoke: Mapping[str, Sequence[str]]

    def __post_init__(self) -> None:
        for name, steps in self.parts.items():
            for number, step in enumerate(steps):
                check_settings(ResultStep, dict(step), f"results.parts.{name}[{number}]")
        if self.part not in ("all", *self.parts):
            raise InputError(f"results.part={self.part} is none of all, {', '.join(self.parts)}")
        if unknown := set(self.optional) - set(self.parts):
            raise InputError(f"results.optional={[*self.optional]}: there is no part {', '.join(unknown)}")

    def steps(self) -> list[ResultStep]:
        """Return the commands of the chosen part, or of all that are not optional."""
        every = [name for name in self.parts if name not in self.optional]
        chosen = every if self.part == "all" else [self.part]
        return [ResultStep(**step) for name in chosen for step in self.parts[name]]


@command("results")
def main(config: Config) -> None:
    """Publish; exit code 1 if a command failed."""
    settings = config.results
    chosen = configured(PublishedResults, settings, "results")

    from skin.core.messages import quiet

    quiet()
    sys.exit(_publish(chosen, config))


def _publish(chosen: PublishedResults, config: Config) -> int:
    """Run the commands of a part; return 1 if one failed."""
    from skin.core.messages import format_duration
    from skin.runs.sweep import SweepProgress

    full, failed = chosen.budget == "full", []
    lines = list(_lines(chosen, config))
    progress = SweepProgress([3600 * hours if full else None for hours, _ in lines])
    for number, (hours, line) in enumerate(lines):
        left = progress.left()
        estimate = "" if left is None else f", about {format_duration(left)} left"
        print(f"== [{number + 1}/{len(lines)}] skin {join(line)}{estimate}", flush=True)
        began = time.monotonic()
        if _fails(line):
            failed.append(f"skin {join(line)}")
        took = time.monotonic() - began
        # A command whose runs have finished before does not tell the speed of this machine.
        progress.finish(number, took, full and took < 0.05 * 3600 * hours)
    if failed:
        print("failed:", *failed, sep="\n", file=sys.stderr)
    return 1 if failed else 0


def _fails(line: Sequence[str]) -> bool:
    """Run a command and return whether it failed; a crash is reported, and must not stop the others."""
    from experiments.studies.trials import run_command
    from skin import __main__ as cli

    try:
        return run_command(cli.main, line) != 0
    except Exception:
        traceback.print_exc()
        return True


def _lines(chosen: PublishedResults, config: Config) -> Iterator[tuple[float, list[str]]]:
    """Yield hours, and verb and overrides, of each command; the overrides of the command line last."""
    smoke = chosen.budget == "smoke"
    passed = [word for word in overrides() if word.split("=")[0].split(".")[0] not in ("results", "out")]
    for step in chosen.steps():
        verb, *words = split(step.run)
        if smoke and _PEERS in words and not peers.python().is_file():
            print(
                f"left out without {peers.python()}, which make peers builds: skin {step.run}",
                file=sys.stderr,
            )
            continue
        if smoke and verb not in chosen.smoke:
            raise InputError(f"results.smoke has no settings for skin {verb}: add +results.smoke.{verb}=[]")
        words += chosen.smoke[verb] if smoke else ()
        if verb != "design":
            words += [f"tracking.{name}={value}" for name, value in _FRESH.items() if chosen.fresh]
        if chosen.jobs > 1 and verb == "train":
            words += ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={chosen.jobs}"]
        if chosen.jobs > 1 and verb == "study":
            words += [f"study.jobs={chosen.jobs}"]
        folder = _folder(chosen, config)
        if verb == "design":  # has no runs, and takes no settings of trainings
            yield step.hours, [verb, *_within(folder, words)]
            continue
        words += [f"out={folder}"] if verb == "study" else []
        yield step.hours, [verb, *words, *passed]


def _within(folder: Path, words: Sequence[str]) -> list[str]:
    """Return overrides with the place of the results in a folder."""
    return [f"out={folder / word[4:]}" if word.startswith("out=") else word for word in words]


def _folder(chosen: PublishedResults, config: Config) -> Path:
    """Return the folder of the published files; smoke budgets are published in a folder in it."""
    from skin.core.files import results

    return results(config.out or ("docs/results" if chosen.budget == "full" else "results"))
