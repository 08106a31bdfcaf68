"""The table of runs in the UI of MLflow: which page opens, and which columns it shows."""

import json
from contextlib import suppress

from mlflow import MlflowClient
from mlflow.entities import Experiment
from mlflow.exceptions import MlflowException

_VIEW = "skin"  # name of the shared view in the link
_NAME = "attributes.`Run Name`"
_COLUMNS = {  # with widths in pixels, so that names are whole
    _NAME: 420,
    "metrics.`same/overall/accuracy`": 180,
    "metrics.`same/dangerous/alarm_recall`": 230,
    "metrics.`same/dangerous/false_alarm_rate`": 250,
    "metrics.`mean/same/overall/accuracy`": 220,
}

TAGS = {
    # Which of its two interfaces MLflow shows. 3.17 takes it from the link instead.
    "mlflow.experimentKind": "custom_model_development",
    f"mlflow.sharedViewState.{_VIEW}": json.dumps(
        {
            "selectedColumns": [name for name in _COLUMNS if name != _NAME],
            "columnOrder": list(_COLUMNS),
            "columnWidths": _COLUMNS,
        }
    ),
}
"""Tags of an experiment that holds runs of this package."""


def tag_experiment(client: MlflowClient, experiment: Experiment) -> None:
    """Add the tags that an experiment lacks; they matter only to the UI, so that failures are ignored."""
    for key, value in TAGS.items():
        if experiment.tags.get(key) != value:
            with suppress(MlflowException):
                client.set_experiment_tag(experiment.experiment_id, key, value)


def table_link(address: str, experiment: str) -> str:
    """Return the link to the table of runs.

    Args:
        address: of the server, as ``http://127.0.0.1:5000``.
        experiment: its id.
    """
    return (
        f"{address}/#/experiments/{experiment}/runs?workflowType=machine_learning&viewStateShareKey={_VIEW}"
    )
