"""The activations that the report compares, by name."""

from torch import nn

from skin.errors import InputError


def activation(name: str) -> nn.Module:
    """Return relu, elu or silu as a module.

    Raises:
        InputError: another name.
    """
    activations = {"relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}
    if name not in activations:
        raise InputError(f"unknown activation {name!r}: set activation=relu, elu or silu")
    return activations[name]()
