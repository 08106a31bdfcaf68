"""The four fast rows written the usual way with PyTorch Geometric, as a reference.

Same networks, same numbers; but a PyTorch Geometric ``Data`` object per graph, and a dense image of three
equal channels per frame, convolved frame by frame. Weights are interchangeable with
``skin.learning.network.TouchClassifier`` by ``take_weights``.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch_geometric.data import Batch, Data
from torch_geometric.nn import AttentionalAggregation, GCNConv, global_max_pool

from skin.device.touches import Touches
from skin.learning.graph import adjacency, neighbours
from skin.learning.representation import pixel_of

PIXELS, SCALE, WINDOW, LABELS = 64, 10.0, 30, 4


class Plain(nn.Module):
    """A network and how its inputs are made, one touch at a time."""

    def samples(self, touches: Touches, size: tuple[float, float]) -> Sequence:
        """Return one sample per touch: graphs as objects, images rendered when asked for (memory)."""
        raise NotImplementedError

    def collate(self, samples: list) -> Batch | Tensor:
        """Return the batch of samples that ``forward`` takes."""
        raise NotImplementedError


def _edges(positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return edge index (2, E) and weights (E,) of the six nearest neighbours."""
    sites = positions.double().numpy()
    weights = torch.from_numpy(adjacency(sites, neighbours(sites, "knn", 6), "exp")).float()
    index = weights.nonzero().T
    return index, weights[index[0], index[1]]


class _Images(Sequence):
    """The images (T, channels, 64, 64) of touches, rendered when they are asked for."""

    def __init__(self, touches: Touches, size: tuple[float, float], channels: int) -> None:
        self.readings, self.channels = touches.readings, channels
        self.where = torch.from_numpy(pixel_of(touches.positions.double().numpy(), size, PIXELS))

    def __len__(self) -> int:
        return len(self.readings)

    def __getitem__(self, index):
        frames = self.readings[index] / SCALE
        images = torch.zeros(len(frames), PIXELS * PIXELS)
        # sensors on one pixel are averaged
        images.scatter_reduce_(1, self.where.expand_as(frames), frames, "mean", include_self=False)
        return images.view(-1, 1, PIXELS, PIXELS).repeat(1, self.channels, 1, 1)


class TemporalGraph(Plain):
    """One ``Data`` per touch; 145,774 parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = GCNConv(WINDOW, 30), GCNConv(30, 500)
        self.norm = nn.BatchNorm1d(30)
        self.dense, self.out = nn.Linear(500, 256), nn.Linear(256, LABELS)

    def samples(self, touches: Touches, size: tuple[float, float]) -> list[Data]:
        """Return a graph per touch, whose nodes hold their frames."""
        index, weights = _edges(touches.positions)
        return [Data(x=one.T / SCALE, edge_index=index, edge_attr=weights) for one in touches.readings]

    def collate(self, samples: list) -> Batch:
        """Return one disjoint graph."""
        return Batch.from_data_list(samples)

    def forward(self, batch: Batch) -> Tensor:
        """Return logits (B, 4)."""
        x = F.silu(self.norm(self.first(batch.x, batch.edge_index, batch.edge_attr)))
        x = F.silu(self.second(x, batch.edge_index, batch.edge_attr))
        return self.out(F.silu(self.dense(global_max_pool(x, batch.batch))))


class SequenceGraph(Plain):
    """One ``Data`` per frame; 105,621 parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = GCNConv(1, 32), GCNConv(32, 128)
        self.pool = AttentionalAggregation(nn.Linear(128, 1))
        self.gru = nn.GRU(128, 128, batch_first=True)
        self.dense, self.out = nn.Linear(128, 16), nn.Linear(16, LABELS)

    def samples(self, touches: Touches, size: tuple[float, float]) -> list[list[Data]]:
        """Return a graph per frame of every touch."""
        index, weights = _edges(touches.positions)
        return [
            [Data(x=frame[:, None] / SCALE, edge_index=index, edge_attr=weights) for frame in one]
            for one in touches.readings
        ]

    def collate(self, samples: list) -> Batch:
        """Return one disjoint graph of all frames of all touches."""
        return Batch.from_data_list([graph for sample in samples for graph in sample])

    def forward(self, batch: Batch) -> Tensor:
        """Return logits (B, 4)."""
        x = F.silu(self.first(batch.x, batch.edge_index, batch.edge_attr))
        x = F.silu(self.second(x, batch.edge_index, batch.edge_attr))
        states = self.gru(self.pool(x, batch.batch).view(-1, WINDOW, 128))[0]
        return self.out(F.relu(self.dense(states[:, -1])))


class TemporalImage(Plain):
    """The frames as channels of an image; 209,844 parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Conv2d(WINDOW, 16, 3), nn.Conv2d(16, 32, 3)
        self.drop = nn.Dropout2d(0.2)
        self.dense, self.out = nn.Linear(6272, 32), nn.Linear(32, LABELS)

    def samples(self, touches: Touches, size: tuple[float, float]) -> Sequence:
        """Return the images (T, 1, 64, 64) of every touch."""
        return _Images(touches, size, channels=1)

    def collate(self, samples: list) -> Tensor:
        """Return the images (B, T, 64, 64)."""
        return torch.cat(samples, dim=1).transpose(0, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (B, 4)."""
        x = self.drop(F.max_pool2d(F.relu(self.first(x)), 2))
        x = self.drop(F.max_pool2d(F.relu(self.second(x)), 2))
        return self.out(F.relu(self.dense(x.flatten(1))))


class SequenceImage(Plain):
    """Three equal channels per frame, convolved frame by frame; 1,634,341 parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Conv2d(3, 8, 3), nn.Conv2d(8, 16, 3)
        self.drop = nn.Dropout2d(0.2)
        self.embedding = nn.Linear(3136, 512)
        self.gru, self.score = nn.GRU(512, 16, batch_first=True), nn.Linear(16, 1)
        self.dense, self.out = nn.Linear(16, 64), nn.Linear(64, LABELS)

    def samples(self, touches: Touches, size: tuple[float, float]) -> Sequence:
        """Return the images (T, 3, 64, 64) of every touch."""
        return _Images(touches, size, channels=3)

    def collate(self, samples: list) -> Tensor:
        """Return the images (B, T, 3, 64, 64)."""
        return torch.stack(samples)

    def encode(self, x: Tensor) -> Tensor:
        """Return the embeddings (B, 512) of one frame of every touch, (B, 3, 64, 64)."""
        x = self.drop(F.max_pool2d(F.relu(self.first(x)), 2))
        x = self.drop(F.max_pool2d(F.relu(self.second(x)), 2))
        return F.relu(self.embedding(x.flatten(1)))

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (B, 4)."""
        states = self.gru(torch.stack([self.encode(frame) for frame in x.unbind(1)], dim=1))[0]
        pooled = (self.score(states).softmax(dim=1) * states).sum(dim=1)
        return self.out(F.relu(self.dense(pooled)))


PLAIN: dict[str, Callable[[], Plain]] = {
    "temporal_graph": TemporalGraph,
    "sequence_graph": SequenceGraph,
    "temporal_image": TemporalImage,
    "sequence_image": SequenceImage,
}


def take_weights(plain: Plain, classifier: nn.Module) -> None:
    """Copy the weights of a ``TouchClassifier`` of the same row into its plain twin.

    Raises:
        ValueError: the two are not the same network.
    """
    theirs, ours = classifier.state_dict().values(), plain.state_dict()
    for (name, target), source in zip(ours.items(), theirs, strict=True):
        if target.shape != source.shape:
            raise ValueError(f"{name} is {tuple(target.shape)} here and {tuple(source.shape)} there")
        target.copy_(source)
