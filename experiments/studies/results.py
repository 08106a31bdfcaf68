"""Make every published result again, or what is missing of it.

    skin results
    skin results results.part=table

Writes into docs/results; rerun to resume.
"""

import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from shlex import join, split
from typing import Annotated, Any

from annotated_types import Ge, Gt

from skin.commands._command import command
from skin.core.files import results as results_folder
from skin.core.settings import configured
from skin.errors import InputError
from skin.runs.configuration import Config, overrides


@dataclass(frozen=True)
class PublishedResults:
    """The settings of ``conf/results.yaml``.

    Raises:
        InputError: a part that there is not.
    """

    part: str
    optional: Sequence[str]
    jobs: Annotated[int, Ge(1)]
    parts: Mapping[str, Sequence[tuple[str, Annotated[float, Gt(0)]]]]

    def __post_init__(self) -> None:
        if self.part not in ("all", *self.parts):
            raise InputError(f"results.part={self.part} is none of all, {', '.join(self.parts)}")

    def lines(self, folder: Path, passed: Sequence[str]) -> Iterator[tuple[float, list[str]]]:
        """Yield hours, and verb and overrides, of each command of the part, or of all but optional ones.

        Args:
            folder: of the results.
            passed: overrides of every training and study.
        """
        chosen = (
            [part for part in self.parts if part not in self.optional] if self.part == "all" else [self.part]
        )
        jobs = {
            "train": ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={self.jobs}"],
            "study": [f"study.jobs={self.jobs}"],
        }
        for run, hours in chain(*(self.parts[part] for part in chosen)):
            verb, *words = split(run)
            if verb == "design":  # has no runs, and takes no settings of trainings
                words = [f"out={folder / word[4:]}" if word.startswith("out=") else word for word in words]
            else:
                parallel, out = jobs.get(verb, []) if self.jobs > 1 else [], [f"out={folder}"]
                words += [*parallel, *(out if verb == "study" else []), *passed]
            yield hours, [verb, *words]


@command("results")
def main(config: Config, results: dict[str, Any], out: str | None) -> None:
    """Publish; exit code 1 if a command failed."""
    chosen = configured(PublishedResults, results, "results")

    from experiments.studies.trials import run_command
    from skin import __main__ as cli
    from skin.core.messages import quiet

    quiet()
    passed = [word for word in overrides() if word.split("=")[0].split(".")[0] not in ("results", "out")]
    folder = results_folder(out or "docs/results")
    failed, lines = [], list(chosen.lines(folder, passed))
    for number, (_, line) in enumerate(lines):
        left = sum(each for each, _ in lines[number:])
        print(f"== [{number + 1}/{len(lines)}] skin {join(line)}, at most {left:.1f} h left", flush=True)
        try:
            code = run_command(cli.main, line)
        except Exception:  # is reported, and must not stop the others
            traceback.print_exc()
            code = 1
        failed += [f"skin {join(line)}"] if code else []
    if failed:
        print("failed:", *failed, sep="\n", file=sys.stderr)
        sys.exit(1)
