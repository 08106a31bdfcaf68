"""Make every published result again, or what is missing of it.

    skin results
    skin results results.part=table

Writes into docs/results; rerun to resume.
"""

import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import join, split
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt

from experiments import peers
from skin.commands._command import command
from skin.core.files import results
from skin.core.settings import configured
from skin.errors import InputError
from skin.runs.configuration import Config, overrides


@dataclass(frozen=True)
class PublishedResults:
    """The settings of ``conf/results.yaml``.

    Raises:
        InputError: a part that there is not, or a verb without a smoke budget.
    """

    part: str
    optional: Sequence[str]
    budget: Literal["full", "smoke"]
    jobs: Annotated[int, Ge(1)]
    fresh: bool
    parts: Mapping[str, Sequence[tuple[str, Annotated[float, Gt(0)]]]]
    smoke: Mapping[str, Sequence[str]]

    def __post_init__(self) -> None:
        if self.part not in ("all", *self.parts):
            raise InputError(f"results.part={self.part} is none of all, {', '.join(self.parts)}")
        if unknown := set(self.optional) - set(self.parts):
            raise InputError(f"results.optional={[*self.optional]}: there is no part {', '.join(unknown)}")
        verbs = {run.split()[0] for steps in self.parts.values() for run, _ in steps}
        if missing := verbs - self.smoke.keys():
            verb = min(missing)
            raise InputError(f"results.smoke has no settings for skin {verb}: add +results.smoke.{verb}=[]")

    def lines(self, folder: Path, passed: Sequence[str]) -> Iterator[tuple[float, list[str]]]:
        """Yield hours, and verb and overrides, of each command of the part, or of all but optional ones.

        Args:
            folder: of the results.
            passed: overrides of every training and study.
        """
        smoke, every = self.budget == "smoke", [name for name in self.parts if name not in self.optional]
        fresh = ["tracking.uri=sqlite:///results/fresh.db", "tracking.artifacts=results/fresh"]
        parallel = {
            "train": ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={self.jobs}"],
            "study": [f"study.jobs={self.jobs}"],
        }
        for run, hours in (step for part in (every if self.part == "all" else [self.part])
                           for step in self.parts[part]):  # fmt: skip
            verb, *words = split(run)
            if smoke and "experiments/peers/conf" in words and not peers.python().is_file():
                missing = f"left out without {peers.python()}, which make peers builds: skin {run}"
                print(missing, file=sys.stderr)
                continue
            words += self.smoke[verb] if smoke else ()
            if verb == "design":  # has no runs, and takes no settings of trainings
                words = [f"out={folder / word[4:]}" if word.startswith("out=") else word for word in words]
            else:
                words += [*(fresh if self.fresh else []), *(parallel.get(verb, []) if self.jobs > 1 else [])]
                words += [*([f"out={folder}"] if verb == "study" else []), *passed]
            yield hours, [verb, *words]


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

    passed = [word for word in overrides() if word.split("=")[0].split(".")[0] not in ("results", "out")]
    # Smoke budgets are published in a folder of their own.
    folder = results(out or ("results" if chosen.budget == "smoke" else "docs/results"))
    failed, lines = [], list(chosen.lines(folder, passed))
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
