"""The logger of a training."""

from pytorch_lightning.loggers import MLFlowLogger

from skin.tracking import Store


class RunLogger(MLFlowLogger):
    """Logs a training to its run and leaves the run open.

    Lightning's own calls a run FINISHED when the fit ends; one that is killed during its evaluation would
    then count as finished without having any result. The client of the store keeps metrics when a server
    does not answer.
    """

    def __init__(self, store: Store, run: str) -> None:
        super().__init__(tracking_uri=store.uri, run_id=run)
        self._mlflow_client, self._experiment_id, self._initialized = store.client, store.experiment, True

    def finalize(self, status: str = "success") -> None:
        """Do nothing: the run ends with its evaluation."""
