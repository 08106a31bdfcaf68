"""A finished run for a live view."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from omegaconf import DictConfig, OmegaConf

from skin.build import build_device
from skin.hardware.live import engine_builder
from skin.hardware.live.live_settings import LiveSettings
from skin.hardware.live.watched import Watched
from skin.run_overrides import apply_overrides
from skin.stored_run import find_run, load_configuration
from skin.tracking import Store
from skin.trained import choose_for_skin, load_trained


def watch_run(
    config: DictConfig, live: LiveSettings, say: Callable[[str], None], given: Sequence[str]
) -> Watched:
    """Return a finished run and the device of a configuration.

    Args:
        config: of the command.
        live: settings of the live view.
        say: called with each message for the user.
        given: settings that replace those of the run, as overrides; ``config`` has their values.

    Raises:
        InputError: there is no such run, or it cannot be loaded.
    """
    torch.set_num_threads(config.tracking.threads or 1)
    store = Store.existing(config.tracking)
    run = find_run(store, config.run)
    stored = load_configuration(store, run, config.trust)
    watched = apply_overrides(stored, config, given)
    device = build_device(watched)
    # The training data stay those of the run, for any watched device.
    trained = apply_overrides(
        stored, config, [one for one in given if not one.startswith(("device=", "device."))]
    )
    title = str(run.info.run_name)
    say(f"loading {title} ({run.info.run_id[:8]})")
    if advice := engine_builder.simulator_warning(stored, device):
        say(advice)
    profile, drawn = watched.evaluation.profile, "skins" in stored.device
    if drawn or profile != OmegaConf.select(stored, "evaluation.profile"):
        devices = "" if profile is None else f" and devices of the profile {profile}"
        say(f"choosing the threshold of the alarm on simulated touches of this skin{devices}")
    of = load_trained(store, run, trained, stored)
    if drawn:
        of = replace(of, point=choose_for_skin(of.learner, stored, watched))
    engine = engine_builder.make_engine(of, live.patience, live.touch, live.drift)
    if of.point is not None:
        above = live.patience.above
        say(of.point.sentence() if above is None else f"alarm above {above:g}")
    return Watched(title, engine, device.source, of.positions.numpy(), of.device.size)
