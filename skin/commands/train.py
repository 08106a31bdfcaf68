"""Train a configuration, or with -m a sweep of them; log every run to MLflow.

    skin train experiment=features
    skin train -m experiment=rules,features seed=0,1,2

A run that finished with the same configuration is skipped; tracking.resume=false trains it again.
"""

from skin.commands._command import command
from skin.runs.configuration import Config


@command()
def main(config: Config) -> float:
    """Train and evaluate one configuration; return ``tracking.objective``, for a sweeper that needs it."""
    from skin.runs.train import train

    return train(config)
