"""Models: encoders of single frames."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from skin.core.settings import checked, option_name
from skin.errors import InputError

if TYPE_CHECKING:
    from torch_geometric.nn.models.basic_gnn import BasicGNN

Kind = Literal["image", "graph", "readings"]


class AbstractModel(nn.Module, ABC):
    """Encodes single frames; the fusion combines them over time.

    Built as ``cls(kind, shape, **options)`` with the kind and the shape of one frame, which the
    representation decides.

    Args:
        kind: kind of representation.

    Attributes:
        takes: the kind of frame that the model encodes.
        width: E, the width of the embedding.

    Raises:
        InputError: the model does not accept this kind.
    """

    takes: ClassVar[Kind]
    width: int

    def __init__(self, kind: Kind) -> None:
        super().__init__()
        if kind != self.takes:
            name = option_name(self)
            raise InputError(
                f"model={name} needs representation={self.takes}, got {kind}: add representation={self.takes}"
            )

    @abstractmethod
    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of frames.

        Args:
            x: images (N, C, H, W), graphs (N, S, F) or readings (N, F).
            adjacency: (S, S) or (N, S, S), normalised; None without a graph.
        """


# The activations that the report compares, by name.


Activation = Literal["relu", "elu", "silu"]
ACTIVATIONS: dict[Activation, Callable[[], nn.Module]] = {"relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}


def dense_layers(widths: Sequence[int], activation: Activation, dropout: float = 0.0) -> list[nn.Module]:
    """Return dense layers of some widths, the first of which is that of the input, with activations.

    Args:
        widths: of the input and of each layer.
        activation: after each layer.
        dropout: fraction of the input of each layer that is dropped in training.
    """
    layers: list[nn.Module] = []
    for pair in pairwise(widths):
        # Without dropout there is no such layer, so that older weights keep their names.
        layers += [*([nn.Dropout(dropout)] if dropout else []), nn.Linear(*pair), ACTIVATIONS[activation]()]
    return layers


# The transformer encoder that models and heads over time share.


def encoder(
    width: int, heads: int, layers: int, feedforward: int, dropout: float, setting: str
) -> nn.TransformerEncoder:
    """Return layers of self-attention (Vaswani et al., 2017) on (N, tokens, width), normed before each part.

    Normed before (Xiong et al., 2020), so that it trains with Adam at 1e-3 without a warm-up.

    Args:
        width: of a token.
        heads: of attention in each layer; they share the width.
        layers: their number.
        feedforward: width of the hidden layer in each of them.
        dropout: fraction of values dropped in training.
        setting: the override that sets the width, named where it does not fit.

    Raises:
        InputError: a width that the heads cannot share.
    """
    if width % heads:
        raise InputError(
            f"{heads} heads of attention must share the width equally, got {setting}={width}: "
            f"set {setting}={-(-width // heads) * heads}"
        )
    layer = nn.TransformerEncoderLayer(
        width, heads, feedforward, dropout, activation="gelu", batch_first=True, norm_first=True
    )
    result = nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)
    for parameter in result.parameters():
        if parameter.ndim > 1:  # torch copies the first layer: without this all would start the same
            nn.init.xavier_uniform_(parameter)
    return result


# Poolings of the nodes of a graph to one vector. PyTorch Geometric's take 2.9 (max), 1.0 to 1.5 (mean), 1.1
# to 1.2 (attention) and 1.0 to 1.3 (set2set) times as long, and 0.7 s to import.

Pooling = Literal["max", "mean", "attention", "set2set"]


class Reduced(nn.Module):
    """A reduction over one dimension, such as ``torch.amax``, without weights.

    Args:
        width: E, of the last dimension.
        reduce: as ``torch.amax``.
        dim: the dimension.
    """

    def __init__(self, width: int, reduce: Callable[..., Tensor], dim: int) -> None:
        super().__init__()
        self.width, self._reduce, self._dim = width, reduce, dim

    def forward(self, x: Tensor) -> Tensor:
        """Return x without the dimension."""
        return self._reduce(x, dim=self._dim)


class Attention(nn.Module):
    """Global attention pooling: the mean of the nodes, weighted by a softmax over a learned gate."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate = nn.Linear(width, 1)
        self.width = width

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, E) of nodes x (S, N, E)."""
        weights = self.gate(x).softmax(dim=0)
        return torch.bmm(weights.permute(1, 2, 0), x.transpose(0, 1)).squeeze(1)


class Set2Set(nn.Module):
    """A recurrent query that reads the nodes by attention, step after step (Vinyals et al., 2016)."""

    def __init__(self, width: int, steps: int = 3) -> None:
        super().__init__()
        self.lstm = nn.LSTMCell(2 * width, width)
        self.width, self.steps = 2 * width, steps

    def forward(self, x: Tensor) -> Tensor:
        """Return the last query and what it read, (N, 2 E), of nodes x (S, N, E)."""
        nodes = x.transpose(0, 1)
        query = memory = x.new_zeros(x.shape[1:])
        read = query
        for _ in range(self.steps):
            query, memory = self.lstm(torch.cat([query, read], dim=-1), (query, memory))
            weights = torch.bmm(nodes, query[:, :, None]).softmax(dim=1)
            read = torch.bmm(weights.mT, nodes).squeeze(1)
        return torch.cat([query, read], dim=-1)


POOLINGS: dict[Pooling, Callable[[int], nn.Module]] = {
    "max": partial(Reduced, reduce=torch.amax, dim=0),
    "mean": partial(Reduced, reduce=torch.mean, dim=0),
    "attention": Attention,
    "set2set": Set2Set,
}
"""Name -> function of E that returns a module (S, N, E) -> (N, ``module.width``)."""


# A plain multi-layer perceptron on the readings.


@checked("model")
class Mlp(AbstractModel):
    """Dense layers on the vector of readings, for one layout only.

    Args:
        kind: must be ``readings``.
        shape: (F,).
        widths: of the layers; the last one is the embedding. Empty: the readings are the embedding, for a
            recurrent head of ``fusion=late``.
        activation: relu, elu or silu, after every layer.
    """

    takes: ClassVar[Kind] = "readings"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        widths: Sequence[int] = (64, 64),
        activation: Activation = "relu",
    ) -> None:
        super().__init__(kind)
        sizes = [*shape, *widths]
        self.layers = nn.Sequential(*dense_layers(sizes, activation))
        self.inputs, self.width = sizes[0], sizes[-1]

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of readings (N, F).

        Raises:
            InputError: the number of readings does not fit the weights.
        """
        if x.shape[-1] != self.inputs:
            raise InputError(
                f"model=mlp is made for {self.inputs} readings per frame, got {x.shape[-1]}: "
                "train with representation=graph or image, which accept other layouts"
            )
        return self.layers(x)


# A transformer over the sensors.


@checked("model")
class Transformer(AbstractModel):
    """Self-attention between all sensors, and a pooling over them (report, section 3.2.2).

    Accepts any layout and number of sensors with the same weights. It does not use the edges of the graph.
    Add ``representation.coordinates=true`` to give it the positions.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        width: of a sensor's token and of the embedding.
        layers: number of encoder layers.
        heads: of attention in each layer; they share the width.
        feedforward: width of the hidden layer in each encoder layer.
        dropout: fraction of values dropped in training, as everywhere in torch's encoder layer.
        pooling: over the sensors: mean or max.

    Raises:
        InputError: not a graph, an unknown pooling, or a width that the heads cannot share.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        width: PositiveInt = 64,
        layers: PositiveInt = 2,
        heads: PositiveInt = 4,
        feedforward: PositiveInt = 128,
        dropout: float = 0.1,
        pooling: Literal["mean", "max"] = "mean",
    ) -> None:
        super().__init__(kind)
        self.tokens = nn.Linear(shape[-1], width)
        self.encoder = encoder(width, heads, layers, feedforward, dropout, "model.width")
        self.pooling, self.width = pooling, width

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F); the adjacency is not used."""
        tokens = self.encoder(self.tokens(x))
        return tokens.amax(dim=1) if self.pooling == "max" else tokens.mean(dim=1)


# A graph convolutional network on the graph of sensors.


Norm = Literal["none", "layer", "batch", "instance"]


class _Convolution(nn.Module):
    """One graph convolution A x W + b (Kipf and Welling, 2017).

    One matrix, normalised once, serves all frames in one product. 1.5 to 3.0 times as fast as PyTorch
    Geometric's DenseGCNConv, 4 to 80 times as its GCNConv.
    """

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, width, bias=False)
        self.bias = nn.Parameter(torch.zeros(width))
        nn.init.xavier_uniform_(self.linear.weight)

    def forward(self, x: Tensor, adjacency: Tensor) -> Tensor:
        """Return nodes (S, N, width) of nodes x (S, N, features) and adjacency (S, S) or (N, S, S)."""
        # neighbours are mixed where there are fewer features; (A x) W = A (x W)
        if self.linear.out_features < self.linear.in_features:
            return _mix(adjacency, self.linear(x)) + self.bias
        return nn.functional.linear(_mix(adjacency, x), self.linear.weight, self.bias)


def _mix(adjacency: Tensor, x: Tensor) -> Tensor:
    """Return A x for nodes x (S, N, F): one large product where the graph is common to all."""
    if adjacency.ndim == 2:
        return (adjacency @ x.flatten(1)).view_as(x)
    return torch.einsum("nij,jnf->inf", adjacency, x)


@checked("model")
class Gcn(AbstractModel):
    """Graph convolutions and a pooling over the nodes (report, sections 3.2.1, 3.2.2 and 3.2.4).

    Accepts any layout and number of sensors with the same weights.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        widths: of the graph convolutions; the last one is the embedding.
        activation: relu, elu or silu, after every convolution.
        norm: between convolutions: none, layer (over the features of a node), batch (over all nodes of all
            graphs) or instance (over the nodes of each graph).
        pooling: over the nodes. max (the report's choice for temporal_graph: many sensors are idle), mean,
            attention (its choice for sequence_graph) or set2set, which doubles the width of the embedding.

    Raises:
        InputError: not a graph, no layer, or an unknown option.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        widths: Annotated[Sequence[PositiveInt], Field(min_length=1)] = (32, 128),
        activation: Activation = "silu",
        norm: Norm = "none",
        pooling: Pooling = "max",
    ) -> None:
        super().__init__(kind)
        sizes = [shape[-1], *widths]
        self.convolutions = nn.ModuleList(_Convolution(*pair) for pair in pairwise(sizes))
        self.activation = ACTIVATIONS[activation]()
        self.norms = nn.ModuleList(_NORMS[norm](width) for width in widths[:-1])
        self.pooling = POOLINGS[pooling](sizes[-1])
        self.width = int(self.pooling.width)  # type: ignore[arg-type]

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F) with their adjacency."""
        assert adjacency is not None  # of a graph
        nodes = x.transpose(0, 1).contiguous()  # nodes first: mixing them is then one product for all graphs
        for convolution, norm in zip(self.convolutions, [*self.norms, nn.Identity()], strict=True):
            nodes = self.activation(norm(convolution(nodes, adjacency)))
        return self.pooling(nodes)


class _BatchNorm(nn.BatchNorm1d):
    """Batch norm over the last axis of nodes (S, N, F)."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.flatten(0, 1)).view_as(x)


class _InstanceNorm(nn.Module):
    """Instance norm (Ulyanov et al., 2016): over its nodes each feature of a graph has mean 0 and spread 1.

    Not torch's, which refuses a graph of one node.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Return nodes (S, N, F) of nodes x (S, N, F)."""
        variance, mean = torch.var_mean(x, dim=0, correction=0)
        return (x - mean) * (variance + 1e-5).rsqrt() * self.weight + self.bias


_NORMS: dict[Norm, Callable[[int], nn.Module]] = {
    "none": nn.Identity,
    "layer": nn.LayerNorm,
    "batch": _BatchNorm,
    "instance": _InstanceNorm,
}

# Networks of PyTorch Geometric.


class Pyg(AbstractModel):
    """A network of PyTorch Geometric on the graph of sensors, and a pooling over the nodes.

    Accepts any layout and number of sensors with the same weights. Networks with edge weights (GCN) use those
    of the graph; the others use only which sensors are neighbours.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        network: a subclass of ``torch_geometric.nn.models.basic_gnn.BasicGNN`` with settings of its own.
        width: of the hidden layers and the embedding.
        layers: number of convolutions.
        pooling: over the nodes: max, mean, attention, or set2set, which doubles the width of the embedding.
        degree: typical number of neighbours; only PNA uses it.

    Raises:
        InputError: not a graph, an unknown pooling, or settings that the network does not take.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        network: Callable[..., "BasicGNN"],
        width: PositiveInt = 64,
        layers: PositiveInt = 2,
        pooling: Pooling = "attention",
        degree: PositiveInt = 7,
    ) -> None:
        super().__init__(kind)
        given = network if isinstance(network, partial) else partial(network)
        self._weighted = bool(getattr(given.func, "supports_edge_weight", False))
        # The adjacency is normalised already.
        defaults: dict[str, Any] = {"normalize": False, "add_self_loops": False} if self._weighted else {}
        if "scalers" in given.keywords:
            defaults["deg"] = torch.nn.functional.one_hot(torch.tensor(degree), degree + 1)
        try:
            self.network = network(shape[-1], width, layers, **defaults)
        except (TypeError, ValueError, AssertionError) as error:
            raise InputError(f"model.network refuses its settings: {error}") from error
        self.pooling = POOLINGS[pooling](width)
        self.width = int(self.pooling.width)  # type: ignore[arg-type]

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F) with their adjacency."""
        assert adjacency is not None  # of a graph
        count, sensors, _ = x.shape
        edges, weights = self._edges(adjacency, count)
        extra = {"edge_weight": weights} if self._weighted else {}
        nodes = self.network(x.flatten(0, 1), edges, **extra)
        return self.pooling(nodes.view(count, sensors, -1).transpose(0, 1).contiguous())

    def _edges(self, adjacency: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the edges (2, E) of all graphs as one, and their weights (E,)."""
        from torch_geometric.utils import dense_to_sparse  # takes seconds to import

        if not self._weighted:  # the others count a node itself by themselves
            loops = torch.eye(adjacency.shape[-1], dtype=torch.bool, device=adjacency.device)
            adjacency = adjacency.masked_fill(loops, 0)
        edges, weights = dense_to_sparse(adjacency.contiguous())
        if adjacency.ndim == 3:
            return edges, weights
        offsets = adjacency.shape[-1] * torch.arange(count, device=adjacency.device)
        return (edges[:, None] + offsets[:, None]).flatten(1), weights.repeat(count)
