"""Make every published result again, or what is missing of it.

    skin results
    skin results results.part=table

Writes into docs/results; rerun to resume.
"""

import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from shlex import join, split
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt

from experiments import peers
from skin.commands._command import command
from skin.core.files import results
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
def main(config: Config, results: dict[str, Any], out: str | None) -> None:
    """Publish; exit code 1 if a command failed."""
    chosen = configured(PublishedResults, results, "results")

    from skin.core.messages import quiet

    quiet()
    sys.exit(_publish(chosen, out))


def _publish(chosen: PublishedResults, out: str | None) -> int:
    """Run the commands of a part; return 1 if one failed."""
    from experiments.studies.trials import run_command
    from skin import __main__ as cli

    failed, lines = [], list(_lines(chosen, out))
    for number, (_, line) in enumerate(lines):
        left = sum(each for each, _ in lines[number:])
        estimate = f", at most {left:.1f} h left" if chosen.budget == "full" else ""
        print(f"== [{number + 1}/{len(lines)}] skin {join(line)}{estimate}", flush=True)
        try:
            code = run_command(cli.main, line)
        except Exception:  # is reported, and must not stop the others
            traceback.print_exc()
            code = 1
        failed += [f"skin {join(line)}"] if code else []
    if failed:
        print("failed:", *failed, sep="\n", file=sys.stderr)
    return int(bool(failed))


def _lines(chosen: PublishedResults, out: str | None) -> Iterator[tuple[float, list[str]]]:
    """Yield hours, and verb and overrides, of each command; the overrides of the command line last."""
    smoke, jobs = chosen.budget == "smoke", chosen.jobs
    passed = [word for word in overrides() if word.split("=")[0].split(".")[0] not in ("results", "out")]
    # Smoke budgets are published in a folder in it.
    folder = results(out or ("results" if smoke else "docs/results"))
    fresh = [f"tracking.{name}={value}" for name, value in _FRESH.items() if chosen.fresh]
    parallel = {
        "train": ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={jobs}"],
        "study": [f"study.jobs={jobs}"],
    }
    for step in chosen.steps():
        verb, *words = split(step.run)
        if smoke and _PEERS in words and not peers.python().is_file():
            missing = f"left out without {peers.python()}, which make peers builds: skin {step.run}"
            print(missing, file=sys.stderr)
            continue
        if smoke and verb not in chosen.smoke:
            raise InputError(f"results.smoke has no settings for skin {verb}: add +results.smoke.{verb}=[]")
        words += chosen.smoke[verb] if smoke else ()
        if verb == "design":  # has no runs, and takes no settings of trainings
            words = [f"out={folder / word[4:]}" if word.startswith("out=") else word for word in words]
            yield step.hours, [verb, *words]
            continue
        words += [*fresh, *(parallel.get(verb, []) if jobs > 1 else [])]
        yield step.hours, [verb, *words, *([f"out={folder}"] if verb == "study" else []), *passed]
