"""The result of a sweep: mean and deviation over seeds of each of its variants."""

import re
import warnings
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from mlflow.entities import Run

from skin.tracking import Store

_MAIN = ("/overall/accuracy", "/alarm_recall", "/false_alarm_rate", "/degrees")
_LEGAL = re.compile(r"[\w.\- ]+")  # part of the name of a metric in MLflow


def sweep_title(jobs: Sequence[Mapping[str, str]], swept: Sequence[str]) -> str:
    """Return the swept settings, such as ``model.norm=none,layer × seed=0,1``, for the name of a run."""
    values = {key: dict.fromkeys(job[key] for job in jobs) for key in swept}
    text = " × ".join(f"{key.lstrip('+')}={','.join(one)}" for key, one in values.items())
    return text if len(text) <= 250 else f"{text[:249]}…"


def log_variants(
    store: Store, parent: Run, keys: Sequence[str], runs: Mapping[tuple[str, ...], Sequence[Run]]
) -> None:
    """Log the main metrics of a sweep to its parent run: as metrics, and as a table with a row per variant.

    A metric that some runs of a variant lack is the mean of the others. Variants whose values make no name in
    MLflow, such as lists, stand in the table alone.

    Args:
        store: where.
        parent: the parent run.
        keys: settings that distinguish the variants.
        runs: values of these settings -> finished runs, one per seed.
    """
    rows: list[dict[str, Any]] = []
    metrics: dict[str, float] = {}
    for values, found in runs.items():
        variant = dict(zip((key.lstrip("+") for key in keys), values, strict=True))
        numbers = {"n": float(len(found))} | _moments(found)
        rows.append(variant | numbers | {"runs": " ".join(run.info.run_id for run in found)})
        if all(map(_LEGAL.fullmatch, values)):
            place = "".join(f"/{key} {value}" for key, value in variant.items())
            metrics |= {f"{name}{place}": number for name, number in numbers.items()}
    store.log_metrics(parent, metrics)
    columns = dict.fromkeys(name for row in rows for name in row)
    table = {name: [row.get(name) for row in rows] for name in columns}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MLflow 3.17 chooses columns in a way that pandas 3 deprecates
        store.client.log_table(parent.info.run_id, table, "variants.json")


def _moments(runs: Sequence[Run]) -> dict[str, float]:
    """Return the mean of each main metric and, of several runs, its standard deviation."""
    names = dict.fromkeys(name for run in runs for name in run.data.metrics if name.endswith(_MAIN))
    found = {}
    for name in names:
        values = [run.data.metrics[name] for run in runs if name in run.data.metrics]
        found[f"mean/{name}"] = fmean(values)
        if len(values) > 1:
            found[f"sd/{name}"] = stdev(values)
    return found
