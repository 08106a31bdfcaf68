"""Train a peer, which is a model of another library, on the same touches.

    skin peers -m row=lightgbm,minirocket,multirocket_hydra seed=0,1,2

lightgbm: boosted trees on the features; minirocket and multirocket_hydra: random convolutions of the readings
and a ridge; ridge: the same ridge on the readings themselves. Peers run in an environment of their own, which
`make peers` builds, and exchange Parquet files with this project. What has finished is skipped.
"""

import subprocess
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from experiments.peers import PEERS
from skin.command import command
from skin.config import plain, validate_config
from skin.errors import InputError
from skin.paths import ROOT

SCRIPT = ROOT / "experiments" / "peers" / "learn.py"
PYTHON = ROOT / ".venv-peers" / "bin" / "python"


@command("peers")
def main(config: DictConfig) -> bool:
    """Train a peer and log its evaluation; return False if there is a finished run already."""
    if config.row not in PEERS:
        raise InputError(f"there is no peer row={config.row}: choose from {', '.join(PEERS)}")
    settings = plain(config)["peers"]
    python = PYTHON if settings["python"] is None else Path(settings["python"])
    if not python.is_file():
        raise InputError(f"there is no {python}: make peers builds it")
    # Settings of the environment are not part of the fingerprint.
    own = validate_config(OmegaConf.masked_copy(config, [str(key) for key in config if key != "peers"]))

    from rich.console import Console

    from experiments.peers.peer_run import learn
    from experiments.studies.runs import newest_finished
    from skin.console import quiet
    from skin.run import simulator
    from skin.tracking import Store

    quiet()
    store, name = Store.open(own.tracking), f"{own.row} {simulator(own)} seed {own.seed}"
    before = newest_finished(store, own) if own.tracking.resume else None
    if before is not None:
        print(f"run {before.info.run_id} did this before: tracking.resume=false repeats it")
        return False
    folder = Path(settings["folder"]).expanduser().resolve()
    with Console(stderr=True).status(name) as status:
        try:
            found = learn(
                store,
                own,
                folder,
                [str(python), str(SCRIPT)],
                lambda doing: status.update(f"{name}: {doing}"),
            )
        except subprocess.CalledProcessError as error:
            raise InputError(f"{name} failed: {error}") from error
    print(f"{name}: {', '.join(f'{column} {100 * value:.1f}' for column, value in found.items())}")
    return True
