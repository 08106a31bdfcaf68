"""
Add a model
===========

An option is a class and a YAML file, and can be in a folder of your own. This tutorial adds a model and
trains it, without a change of the package. :doc:`/contributing` has the rules, and examples of the other
groups.
"""

import sys
from contextlib import chdir
from pathlib import Path
from tempfile import mkdtemp

from skin.__main__ import main

folder = Path(mkdtemp())

# %%
# The class
# ---------
# A model maps a frame to an embedding of ``width`` numbers. A fusion applies it to the frames of a window,
# and linear layers turn the result into labels. Settings are annotated parameters.

(folder / "squared.py").write_text(
    '''
from collections.abc import Sequence
from typing import Annotated

from annotated_types import Ge
from torch import Tensor, nn

from skin.learning.model import AbstractModel, Kind


class Squared(AbstractModel):
    """A dense layer with squared positive outputs."""

    takes = "readings"

    def __init__(self, kind: Kind, shape: Sequence[int], width: Annotated[int, Ge(1)] = 32) -> None:
        super().__init__(kind)
        self.width = width
        self.layer = nn.Linear(shape[0], width)

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return embeddings (N, E) of readings (N, F)."""
        return nn.functional.relu(self.layer(x)).square()
'''
)

# %%
# Its settings
# ------------
# The file has the name of the option, in a folder with the name of the group.

(folder / "conf" / "model").mkdir(parents=True)
(folder / "conf" / "model" / "squared.yaml").write_text(
    """_target_: squared.Squared
_partial_: true
_convert_: all
width: 32
"""
)

# %%
# Train it
# --------
# ``--config-dir`` adds the folder. Every other part is chosen as usual. Ten epochs of a few touches only show
# that it works.

sys.path.insert(0, str(folder))  # in a shell: export PYTHONPATH=$PWD
with chdir(folder):
    main(
        [
            "train",
            "--config-dir",
            "conf",
            "representation=readings",
            "model=squared",
            "simulator=naive",
            "data.gestures=400",
            "trainer.max_epochs=10",
            "device.test_gestures=200",
            "evaluation.safe_gestures=2000",
            "evaluation.devices=0",
            "evaluation.layouts=0",
        ]
    )

# %%
# Settings are checked
# --------------------
# A value outside the range of the annotation is refused before anything is computed.

try:
    with chdir(folder):
        main(["train", "--config-dir", "conf", "model=squared", "model.width=0", "simulator=naive"])
except SystemExit as stop:
    print("exit code", stop.code)
