"""Silence library messages that a user of the command line cannot act on."""

import logging
import warnings


def quiet() -> None:
    """Quieten Lightning's remarks on hardware and logging, and torch's on a change in its own insides."""
    for name in ("lightning_fabric", "pytorch_lightning", "pytorch_lightning.utilities.rank_zero"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.setLevel(logging.ERROR)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    logging.getLogger("mlflow").setLevel(logging.WARNING)
    logging.getLogger("urllib3.connectionpool").addFilter(_tell_of_server)
    warnings.filterwarnings("ignore", message=".*treespec.*", category=FutureWarning)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*`srun` command is available.*")  # one task needs none


def _tell_of_server(record: logging.LogRecord) -> bool:
    """Say in plain words that a request to the tracking server is repeated."""
    if "/mlflow" in str(record.args):
        record.msg, record.args = "the tracking server does not answer: trying again", ()
    return True
