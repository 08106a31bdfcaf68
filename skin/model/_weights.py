"""Files of trained weights: where they lie, and whether they fit."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from skin.errors import InputError
from skin.paths import candidates

_OFFICIAL = "efficientnet_b0_rwightman-7f5810bc.pth"
_SOURCE = f"https://download.pytorch.org/models/{_OFFICIAL}"
_WAYS = "model.weights=random trains from scratch"


def find_weights(weights: str) -> Path:
    """Return the file that ``model.weights`` stands for.

    Args:
        weights: a path, looked for in the current folder, then beside the package; or ``imagenet``:
            torchvision's file of EfficientNet-B0 in ``hub/checkpoints`` of ``$TORCH_HOME``, where torchvision
            itself would keep it.

    Raises:
        InputError: there is no such file.
    """
    if weights == "imagenet":
        folder = Path(torch.hub.get_dir()).expanduser() / "checkpoints"
        # the official one first, then older or newer ones
        named = [folder / _OFFICIAL, *sorted(folder.glob("efficientnet_b0*.pth"))]
        missing = (
            f"model.weights=imagenet needs {_OFFICIAL} in {folder}, which is not there: "
            f"put it there from {_SOURCE}, or give model.weights=FILE.pth; {_WAYS}"
        )
    else:
        named = candidates(weights)
        looked = " and ".join(dict.fromkeys(map(str, named)))
        missing = (
            f"no weights file {weights}: looked for {looked}; "
            f"give model.weights=FILE.pth or model.weights=imagenet; {_WAYS}"
        )
    file = next((path for path in named if path.is_file()), None)
    if file is None:
        raise InputError(missing)
    return file


def load_weights(module: nn.Module, path: Path, spare: tuple[str, ...]) -> None:
    """Give a module the weights of a file, without running code that the file may hold.

    Args:
        module: takes all of them or none.
        path: of a state dict.
        spare: names that the file may hold and the module has no use for.

    Raises:
        InputError: the file cannot be read, is no state dict, or holds other weights than the module has.
    """
    content, state = _read(path), module.state_dict()
    if wrong := _unfit(content, state, spare):
        raise InputError(
            f"the weights file {path} {wrong}: model=efficientnet needs the state dict of torchvision's "
            f"efficientnet_b0; {_WAYS}"
        )
    module.load_state_dict(state | {name: content[name] for name in content if name not in spare})


def _read(path: Path) -> Any:
    try:
        return torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises nearly anything on a file that it cannot read
        # torch's own words would advise to run the code in the file
        reason = error.strerror if isinstance(error, OSError) else "it is damaged, or holds more than tensors"
        raise InputError(f"cannot read the weights file {path}: {reason}; get it again; {_WAYS}") from error


def _unfit(content: Any, state: dict[str, Tensor], spare: tuple[str, ...]) -> str:
    """Return what is wrong with the content of a file; empty if it fits."""
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        return "is no state dict (names and tensors)"
    stored = {name: value for name, value in content.items() if name not in spare}
    # they count batches for a momentum that is not used; files older than torch 0.4.1 have none
    missing = [name for name in state if name not in stored and not name.endswith("num_batches_tracked")]
    foreign = [name for name in stored if name not in state]
    if missing or foreign:
        return " and ".join(filter(None, [_listed("lacks", missing), _listed("has the unknown", foreign)]))
    for name, value in stored.items():
        if value.shape != state[name].shape:
            return f"has {name} of shape {tuple(value.shape)} where {tuple(state[name].shape)} is needed"
        if not value.isfinite().all():
            return f"has numbers in {name} that are not finite"
    return ""


def _listed(verb: str, names: list[str]) -> str:
    remainder = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{verb} {', '.join(names[:3])}{remainder}" if names else ""
