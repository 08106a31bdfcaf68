"""Try a trained run on other touches: python experiments/evaluate.py run=latest device.seed=7"""

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from skin.config import command


@command("evaluate")
def main(config: DictConfig) -> None:
    """Bring a finished run back, evaluate it, print the figures and log them beside the run."""
    from skin.build import build_data, build_device, build_learner
    from skin.console import quiet
    from skin.evaluation import evaluate
    from skin.reload import changed, configuration, find, restore
    from skin.results.show import report
    from skin.tracking import Store

    quiet()
    store = Store.open(config.tracking)
    run = find(store, config.run)
    overrides = list(HydraConfig.get().overrides.task)
    config = changed(configuration(store, run), config, overrides)
    device = build_device(config)
    learner = build_learner(config)
    restore(store, run, learner, build_data(config, device))
    found = evaluate(learner, device, config.evaluation)
    tags = {"evaluated": run.info.run_id, "overrides": " ".join(overrides)}
    with store.run(f"evaluation of {run.info.run_name}", tags, run.info.run_id) as evaluation:
        store.log_metrics(evaluation, found.metrics)
    report(found, f"{run.info.run_name} ({run.info.run_id})")


if __name__ == "__main__":
    main()
