"""Write docs/reproduce.md: every statement, tested on the published results. Draw the methods side by side.

    python -m experiments.studies.reproduce

The statements are in conf/study/, and those without a study in statements.yaml beside this file.
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from experiments.studies.comparison import conclude, uncertainty, values
from experiments.studies.pages import comparison_text
from experiments.studies.study import Statement, Study, configured_study, trained_settings
from skin.core.files import CONF, ROOT, write
from skin.core.settings import configured
from skin.plot.figures import COLOURS, save_figure

_PAGE = ROOT / "docs" / "reproduce.md"
_HEAD = """# Reproduction of the report's statements

Written by `python -m experiments.studies.reproduce` from the statements of studies and published results.

- `study=…` is short for `skin study study=…`. Empty cells repeat the command above. Default settings,
  three or five seeds. In parentheses: report sections.
- Differences are in percentage points, ± [margin](protocol.md#intervals-and-comparisons) over seeds and
  devices; other test gestures add some tenths. *agree* and *disagree* need three seeds, or devices of one
  training. With so many statements, some are due to chance.
- Images have a tenth of the gestures: too few for a GRU or LSTM alone.
"""


def reproduce_page() -> str:
    """Return the page of the committed files."""
    studies, parts = dict(every_study()), [_HEAD]
    sections: Any = OmegaConf.to_container(OmegaConf.load(Path(__file__).with_name("statements.yaml")))
    for section in sections:
        parts.append(f"\n## {section['title']}\n\n| statement | command | outcome |\n|---|---|---|\n")
        for name in section["studies"]:
            parts += _study_lines(*studies[name])
        parts += map(_other_line, section["statements"])
    return "".join(parts)


def every_study() -> Iterator[tuple[str, tuple[str, Study]]]:
    """Yield the name of each comparison, with its command and its settings."""
    base: Any = OmegaConf.to_container(OmegaConf.load(CONF / "study.yaml").study)
    for path in sorted((CONF / "study").glob("*.yaml")):
        settings: Any = base | OmegaConf.to_container(OmegaConf.load(path), resolve=False)  # type: ignore[operator]
        parts = settings.pop("parts")
        del settings["part"]
        for name in parts or [path.stem]:
            command = f"study={path.stem}" + (f" study.part={name}" if parts else "")
            yield name, (command, configured_study(settings | parts.get(name, {}), name))


def published_trials(name: str, chosen: Mapping[str, Mapping[str, str]] | None = None) -> pd.DataFrame:
    """Return the trials in a published file of a study; none without the file.

    Args:
        name: of the study.
        chosen: settings of each variant, by its name.
    """
    path = ROOT / "docs" / "results" / f"study_{name}.csv"
    if not path.exists():
        return pd.DataFrame()
    texts = dict.fromkeys(("variant", "seed", "condition", "device", "run"), str)
    trials = pd.read_csv(path, dtype=texts)
    for column in texts:
        trials[column] = trials[column].fillna("") if column in trials else ""
    if trials.seed.nunique() == 1 and trials.device.any():  # several devices of one training are the sample
        trials["seed"] = trials.device
    settings = {each: {"name": each, "row": each.split()[0]} for each in trials.variant} | dict(chosen or {})
    trials["chosen"] = trials.variant.map(settings)
    return trials.assign(device="", outcomes=None)


_METHODS = {
    **{f"{name} (report)": ("fem " + name, "", COLOURS[0]) for name in (
        "linked_graph", "sequence_graph", "temporal_image", "sequence_image", "temporal_graph")},
    "boosted trees": ("features", "", COLOURS[1]),
    "best_fresh": ("best_fresh", "", COLOURS[2]),
    "any_skin (solid)": ("any_skin", "25 sensors", COLOURS[3]),
}  # fmt: skip
"""Name -> variant, condition and colour; the networks of the report share one."""

_QUANTITIES = (
    ("same/overall/accuracy", 4000, "accuracy of the four labels, %"),
    ("same/dangerous/alarm_recall", 2000, "recall of dangerous touches, %"),
)
"""Metric, number of test gestures that count, and label."""


def methods_figure() -> Figure:
    """Draw accuracy and recall of each method, from the published files.

    Intervals are over trainings and over gestures, of which the latter are those of a binomial distribution.
    """
    trials = pd.concat(map(published_trials, ("table", "table_best", "any_skin")))
    figure = Figure(figsize=(9, 3), layout="constrained")
    panels = figure.subplots(ncols=2, sharey=True)
    for axis, (metric, count, label) in zip(panels, _QUANTITIES, strict=True):
        for number, (variant, condition, colour) in enumerate(_METHODS.values()):
            figures = values(trials[(trials.variant == variant) & (trials.condition == condition)], metric)
            mean = figures.mean()
            margin = math.hypot(uncertainty(figures)[1], 1.96 * math.sqrt(mean * (100 - mean) / count))
            axis.errorbar(mean, -number, xerr=margin, fmt="o", color=colour, ms=5, capsize=3)
        axis.set(xlabel=label, xlim=(None, 101))
        axis.grid(alpha=0.3)
    panels[0].set_yticks(range(0, -len(_METHODS), -1), _METHODS)
    figure.suptitle("4000 simulated touches; mean and 95 % interval over trainings and touches", fontsize=9)
    return figure


def _study_lines(command: str, study: Study) -> Iterator[str]:
    trials = published_trials(study.name, trained_settings(study))
    if trials.empty:
        yield _line(f"{len(study.statements)} on the {study.about}", f"`{command}`", "*not tested*")
        return
    for number, statement in enumerate(study.statements):
        yield _tested(statement, "" if number else f"`{command}`", trials)


def _other_line(settings: dict[str, Any]) -> str:
    """Return the line of a statement without a study: it states its outcome, or a published file tests it."""
    if "outcome" in settings:
        command = settings.get("command", "")
        quoted = f"`{command}`" if command and not command.startswith("[") else command
        return _line(settings["says"], quoted, settings["outcome"])
    name = settings.pop("results")
    statement = configured(Statement, {"id": ""} | settings, "statement")
    return _tested(statement, f"[values](results/study_{name}.csv)", published_trials(name))


def _tested(statement: Statement, command: str, trials: pd.DataFrame) -> str:
    """Return the line of a statement that trials decide."""
    says = statement.says + (f" ({statement.section})" if statement.section else "")
    result = conclude(statement, trials)
    return _line(says, command, f"{comparison_text(result).replace(' points', '')}: *{result.verdict}*")


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |\n"


if __name__ == "__main__":
    print(write(reproduce_page(), _PAGE))
    print(save_figure(methods_figure(), _PAGE.with_name("results") / "methods.png"))
