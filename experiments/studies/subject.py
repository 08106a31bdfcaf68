"""What a study measures, and what it finds."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from skin.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from mlflow.entities import Run
    from omegaconf import DictConfig

    from experiments.studies.tables import Page
    from skin.device.base import AbstractDevice
    from skin.evaluation.operating_point import OperatingPoint
    from skin.learner.base import AbstractLearner
    from skin.model_of_run import RunModel
    from skin.tracking import Store


@dataclass(frozen=True)
class Finished:
    """A finished run.

    Attributes:
        store: where it is.
        run: as MLflow has it.
        stored: its configuration.
        trained: what it learned, and the device that it was trained on.
    """

    store: "Store"
    run: "Run"
    stored: "DictConfig"
    trained: "RunModel"


@dataclass(frozen=True)
class Subject:
    """The subject of a measure.

    Attributes:
        config: of the run, with the changes of the condition; that of the command without a run.
        device: as ``config`` describes it.
        finished: the run; None where a study has none.
    """

    config: "DictConfig"
    device: "AbstractDevice"
    finished: Finished | None = None

    @property
    def of(self) -> Finished:
        """The run.

        Raises:
            InputError: there is none.
        """
        if self.finished is None:
            raise InputError("this study needs a finished run: study.run=latest, or study.rows=[features]")
        return self.finished

    @property
    def title(self) -> str:
        """The name of the run, for pages and figures."""
        run = self.of.run
        # As in the published tables; the id of a run differs between databases.
        return f"{run.info.run_name}, run {run.data.tags.get('fingerprint', run.info.run_id)[:8]}"

    @property
    def learner(self) -> "AbstractLearner":
        """What the run learned."""
        return self.of.trained.learner

    def point(self) -> "OperatingPoint":
        """Return where the run raises the alarm on this device."""
        from skin.alarm_threshold import alarm_point
        from skin.evaluation.operating_point import OperatingPoint

        run = self.of.trained.run
        point = self.of.trained.point if run is None else alarm_point(run, self.learner, self.config)
        return point or OperatingPoint.default(self.config.evaluation.false_alarm_rate)


@dataclass(frozen=True)
class Measurement:
    """The result of a measure.

    Attributes:
        metrics: name -> value; shares are of 1.
        page: what is published; None where the metrics tell everything.
        outcomes: of each test gesture (:func:`skin.evaluation.outcomes.encode`); None: not known.
        cannot: why the learner does not accept the touches; empty where it does.
    """

    metrics: dict[str, float]
    page: "Page | None" = None
    outcomes: "np.ndarray | None" = None
    cannot: str = ""


class Measure(Protocol):
    """A frozen dataclass of settings that measures."""

    def __call__(self, subject: Subject) -> Measurement:
        """Measure; InputError where the device or the learner cannot be measured so."""
