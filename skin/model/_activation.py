"""The activations that the report compares, by name."""

from torch import nn

from skin.errors import InputError


def activation(name: str) -> nn.Module:
    """Return relu, elu or silu as a module.

    Raises:
        InputError: another name.
    """
    known = {"relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}
    if name not in known:
        raise InputError(f"unknown activation {name!r}: set activation=relu, elu or silu")
    return known[name]()
