"""A peer's run: export touches, train in its own environment, log its metrics as for any row."""

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from experiments.peers.exchange import ABOUT, PeerPredictions, export_touches
from skin.build import build_device
from skin.class_balance import report_balance
from skin.config import fingerprint, plain
from skin.evaluation.operating_point import choose_operating_point
from skin.evaluation.report import evaluate
from skin.run import describe, log_report, tags
from skin.tracking import Store

_SOURCES = ("seed", "touch", "body", "layout", "simulator", "device", "data", "evaluation")


def learn(
    store: Store, config: DictConfig, folder: Path, command: Sequence[str], say: Callable[[str], None]
) -> dict[str, float]:
    """Train the peer ``config.row`` and log its run; return its overall accuracy in each column.

    Args:
        store: where to log.
        config: ``row`` names the peer; seed, device, data and evaluation are used, other settings are not.
        folder: for exchanged files, with a subfolder per configuration of touches.
        command: runs the script of the peers; the peer's name, the folder, ``--seed`` and ``--jobs`` follow.
        say: called with progress messages.

    Raises:
        InputError: the device is not simulated, so there are no unseen devices and layouts.
        subprocess.CalledProcessError: the peer failed.
    """
    source, identity = _source(config), tags(config)
    device = build_device(config).simulated("peers are compared on simulated touches")
    report_balance(device)
    where = folder / f"{identity['simulator']}-{config.seed}-{fingerprint(source)}"
    with store.run(f"{config.row} {identity['simulator']} {config.seed}", identity) as run:
        describe(
            store, run.info.run_id, OmegaConf.create({"row": config.row, **source}), device.touches("train")
        )
        say("writing touches")
        export_touches(device, config.evaluation, where)
        if not (config.tracking.resume and (where / config.row / ABOUT).is_file()):
            jobs = ["--seed", str(config.seed), "--jobs", str(torch.get_num_threads())]
            _follow([*command, config.row, str(where), *jobs], say)
        say("evaluating")
        peer = PeerPredictions(where, config.row, device.task)
        point = choose_operating_point(peer, device, config.evaluation)
        report = evaluate(peer, device, config.evaluation, point)
        values = {"seconds_per_epoch": peer.about["seconds"], "parameters": peer.about["parameters"]}
        log_report(store, run, report, device.task, values)
        store.client.log_dict(run.info.run_id, peer.about, ABOUT)
    suffix = "/overall/accuracy"
    return {name.removesuffix(suffix): x for name, x in report.metrics.items() if name.endswith(suffix)}


def _source(config: DictConfig) -> DictConfig:
    """Return the part of a configuration that decides the touches, with all values resolved."""
    whole = plain(config)
    return OmegaConf.create({key: whole[key] for key in _SOURCES})


def _follow(command: list[str], say: Callable[[str], None]) -> None:
    """Run a command and pass on each line of its output."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stdout or ():
                say(line.strip())
        except BaseException:
            process.terminate()
            raise
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
