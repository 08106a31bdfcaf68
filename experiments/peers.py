"""Train what others built on the same touches: python experiments/peers.py --seeds 3 --simulators naive,fem

lightgbm: boosted trees on the engineered measurements; minirocket and multirocket_hydra: random
convolutions of the readings and a ridge; ridge: the same ridge on the plain readings. They live in
.venv-peers, which `make peers` builds, and meet this project in the Parquet files of results/peers only.
What is finished is skipped.
"""

import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from omegaconf import DictConfig

from peers import PEERS
from skin.config import ROOT
from skin.errors import InputError
from skin.files import results
from studies.cli import configuration, jobs, names, parser, refusing

SCRIPT = Path(__file__).parent / "peers" / "learn.py"
PYTHON = ROOT / ".venv-peers" / "bin" / "python"


@refusing
def main() -> None:
    """Train the peers that are missing and log what their answers are worth; exit code 1 if one failed."""
    arguments = parser(__doc__)
    arguments.add_argument("--peers", type=names, default=PEERS[:3], metavar=",".join(PEERS))
    arguments.add_argument("--folder", type=Path, default=results(None) / "peers", help="for the files")
    arguments.add_argument("--python", type=Path, default=PYTHON, help="of their environment")
    chosen = arguments.parse_intermixed_args()
    if unknown := [peer for peer in chosen.peers if peer not in PEERS]:
        raise InputError(f"there is no peer {unknown[0]}: choose from {', '.join(PEERS)}")
    configs = [configuration(*job, f"row={peer}") for job in jobs(chosen) for peer in chosen.peers]
    if not chosen.python.is_file():
        raise InputError(f"there is no {chosen.python}: make peers builds it")

    from rich.progress import Progress

    from skin.console import quiet

    quiet()
    failed = 0
    with Progress() as progress:
        task = progress.add_task("", total=len(configs))
        for config in configs:
            name = f"{config.row} {config.data.name} {config.seed}"

            def say(doing: str, name: str = name) -> None:
                progress.update(task, description=f"{name}: {doing}")

            try:
                found = _compare(config, chosen, say)
                progress.console.print(f"{name}: {found}", highlight=False, soft_wrap=True)
            except subprocess.CalledProcessError as error:
                failed += 1
                progress.console.print(f"{name} failed: {error}", soft_wrap=True)
            progress.advance(task)
    sys.exit(1 if failed else 0)


def _compare(config: DictConfig, chosen: Namespace, say: Callable[[str], None]) -> str:
    """Train one peer unless a finished run holds its results already; return what came out."""
    from peers.runs import learn
    from skin.run import tags
    from skin.tracking import Store

    store, identity = Store.open(config.tracking), tags(config)
    finished = store.find("FINISHED", fingerprint=identity["fingerprint"]) if config.tracking.resume else []
    if finished:
        return f"run {finished[0].info.run_id} did this before"
    found = learn(store, config, chosen.folder.resolve(), [str(chosen.python), str(SCRIPT)], say)
    return ", ".join(f"{name} {100 * value:.1f}" for name, value in found.items())


if __name__ == "__main__":
    main()
