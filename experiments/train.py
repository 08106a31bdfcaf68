"""Train one configuration, or a sweep of them with -m; every run is logged to MLflow."""

from skin.config import DictConfig, command


@command()
def main(config: DictConfig) -> bool:
    """Train and evaluate one configuration; False if that was done before."""
    from skin.run import train

    return train(config)


if __name__ == "__main__":
    main()
