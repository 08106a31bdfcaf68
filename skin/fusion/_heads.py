"""How a sequence of embeddings becomes one."""

from collections.abc import Callable

from torch import Tensor, nn

__all__ = ["HEADS"]


class Mean(nn.Module):
    """The mean over time."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.width = width

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, E) of x (B, T, E)."""
        return x.mean(dim=1)


class Max(nn.Module):
    """The maximum over time."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.width = width

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, E) of x (B, T, E)."""
        return x.amax(dim=1)


class Convolution(nn.Module):
    """A convolution over three frames, ReLU, and the maximum over time."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.layer = nn.Conv1d(width, hidden, 3, padding=1)
        self.width = hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        return self.layer(x.mT).relu().amax(dim=-1)


class Recurrent(nn.Module):
    """The last state of a recurrent layer."""

    def __init__(self, layer: nn.GRU | nn.LSTM) -> None:
        super().__init__()
        self.layer = layer
        self.width = layer.hidden_size

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        return self.layer(x)[0][:, -1]


class AttentionGru(nn.Module):
    """The mean of a GRU's states, weighted by a softmax over a learned score of each."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.layer = nn.GRU(width, hidden, batch_first=True)
        self.score = nn.Linear(hidden, 1)
        self.width = hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        states = self.layer(x)[0]
        return (self.score(states).softmax(dim=1) * states).sum(dim=1)


HEADS: dict[str, Callable[[int, int], nn.Module]] = {
    "mean": Mean,
    "max": Max,
    "conv": Convolution,
    "lstm": lambda width, hidden: Recurrent(nn.LSTM(width, hidden, batch_first=True)),
    "gru": lambda width, hidden: Recurrent(nn.GRU(width, hidden, batch_first=True)),
    "attention+gru": AttentionGru,
}
"""Each makes a module (B, T, E) -> (B, ``module.width``) from E and the width of its hidden layer."""
