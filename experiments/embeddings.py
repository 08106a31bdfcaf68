"""Compare pretrained graph embeddings with plain readings: python experiments/embeddings.py run=latest"""

from typing import TYPE_CHECKING

from skin.command import command
from skin.config import DictConfig, overrides, plain
from skin.errors import InputError
from skin.files import results
from studies.embedding.settings import Probing

if TYPE_CHECKING:
    from skin.learner.network import Network

ABOUT = """
The labels: accuracy on held-out touches of an SVM (radial basis functions on standardised vectors, cost
chosen by cross-validation on the training touches). Graph embeddings and "readings, one frame" see the
strongest frame of a touch alone, the encoder and "readings, window" all: one frame does not tell how long
or where to. Layout: the same SVM on touches of several scattered layouts, whose graphs differ in
morphology; beside it the share of an embedding's variance there that the layout explains, and the share
that the best label does. On one layout all graphs have one morphology: labelled by degree, as Graph2Vec
usually is, they are all equal.
"""


@command("embeddings")
def main(config: DictConfig) -> None:
    """Probe every embedding; write embeddings.md and figure 5 to a folder, and print the table."""
    settings, learner = Probing(**plain(config)["embeddings"]), None

    from rich.console import Console
    from rich.progress import track

    from skin.balance import announce
    from skin.build import build_device
    from skin.files import write
    from skin.plot.figures import save
    from studies.embedding.probe import probe
    from studies.embedding_spaces import lines, spaces, statements
    from studies.table import markdown

    folder = results(config.out)
    if config.run is not None:
        config, learner = _encoder(config)
    device = build_device(config)
    announce(device)
    names, console = device.task.names, Console(stderr=True)
    each = len(settings.attributes) * 3 + (learner is not None) + 2
    steps = probe(device, settings, learner)
    found = list(track(steps, "probing", each * len(settings.seeds), console=console))
    console.print("t-SNE of the first seed")
    figure = spaces([one for one in found if one.seed == found[0].seed], names)
    path = save(figure, folder / "figure05_embeddings.png")
    table = markdown(lines(found, names), "What an SVM reads in embeddings, accuracy in per cent")
    about = f"{ABOUT}\n" + "".join(f"- {line}\n" for line in statements(found, names))
    write(table + about, folder / "embeddings.md")
    print(table + about + f"\n{folder / 'embeddings.md'} and {path.name} beside it")


def _encoder(config: DictConfig) -> tuple[DictConfig, "Network"]:
    """Bring a finished run back: its configuration with the changes asked for, and its network."""
    from skin.build import build_data, build_device, build_learner
    from skin.console import quiet
    from skin.learner.network import Network
    from skin.reload import changed, configuration, find, restore
    from skin.tracking import Store

    quiet()
    store = Store.open(config.tracking)
    run = find(store, config.run)
    given = [one for one in overrides() if not one.startswith("embeddings.")]
    config = changed(configuration(store, run, config.trust), config, given)
    learner = build_learner(config)
    if not isinstance(learner, Network):
        raise InputError(
            f"run {run.info.run_id} is of {config.row}, which has no encoder: give a run of a network"
        )
    restore(store, run, learner, build_data(config, build_device(config)))
    return config, learner


if __name__ == "__main__":
    main()
