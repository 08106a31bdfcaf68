"""Time of PyTorch Geometric's layers over that of skin's own, forward and backward, at the sizes of two rows.

skin bench benchmark=layers

On one thread, the median of that many repeats in turns. A batch has 64 windows of 30 frames and 25 sensors.
"""

import time
from collections.abc import Callable
from itertools import pairwise
from statistics import median

import numpy as np
import torch
from pydantic import PositiveInt
from torch import Tensor, nn
from torch_geometric.nn import DenseGCNConv, GCNConv, aggr

from skin.model._pooling import POOLINGS, Pooling, Set2Set
from skin.model.gcn import _Convolution
from skin.representation.graph import adjacency, neighbours, normalised

SENSORS = 25
ROWS = {"temporal_graph": (64, (30, 30, 500)), "sequence_graph": (64 * 30, (1, 32, 128))}
"""Row -> graphs in a batch, and the number of features before and after each convolution."""

Task = Callable[[Tensor], Tensor]


def edges() -> Tensor:
    """Return weights (S, S) of the edges of a layout, without loops."""
    places = 0.16 * np.random.default_rng(0).random((SENSORS, 3))
    return torch.from_numpy(adjacency(places, neighbours(places, "knn"), "exp")).float()


def convolutions(first: int, second: int, graphs: int) -> tuple[Task, dict[str, Task]]:
    """Return skin's graph convolution of nodes (S, N, first), and PyTorch Geometric's with the same weights.

    Theirs return nodes (N, S, second) or (N S, second).
    """
    weights = edges()
    matrix = torch.from_numpy(normalised(weights.double().numpy())).float()
    ours, dense, sparse = _Convolution(first, second), DenseGCNConv(first, second), GCNConv(first, second)
    sparse.normalize = False
    for theirs in (dense, sparse):
        theirs.lin.weight.data = ours.linear.weight.data
    index = matrix.nonzero().T
    values = matrix[index[0], index[1]]
    offsets = SENSORS * torch.arange(graphs)
    disjoint = (index[:, None] + offsets[:, None]).flatten(1), values.repeat(graphs)
    return lambda x: ours(x, matrix), {
        "DenseGCNConv": lambda x: dense(x.transpose(0, 1), weights),
        "GCNConv, one graph": lambda x: sparse(x.transpose(0, 1), index, values),
        "GCNConv, disjoint graphs": lambda x: sparse(x.transpose(0, 1).flatten(0, 1), *disjoint),
    }


def poolings(name: Pooling, width: int, graphs: int) -> tuple[Task, dict[str, Task]]:
    """Return skin's pooling of nodes (S, N, width), and PyTorch Geometric's with the same weights."""
    ours = POOLINGS[name](width)
    if isinstance(ours, Set2Set):
        whole = aggr.Set2Set(width, processing_steps=3)
        whole.lstm.load_state_dict({f"{key}_l0": value for key, value in ours.lstm.state_dict().items()})
        theirs: nn.Module = whole
    elif name == "attention":
        theirs = aggr.AttentionalAggregation(ours.gate)
    else:
        theirs = {"max": aggr.MaxAggregation, "mean": aggr.MeanAggregation}[name]()
    graph = torch.arange(graphs).repeat_interleave(SENSORS)
    one = torch.zeros(SENSORS, dtype=torch.long)
    found: dict[str, Task] = {
        "disjoint graphs": lambda x: theirs(x.transpose(0, 1).flatten(0, 1), graph, dim_size=graphs)
    }
    if name != "set2set":
        found["along the first axis"] = lambda x: theirs(x, one, dim_size=1, dim=0)[0]
    return ours, found


def measure_layers(repeats: PositiveInt) -> dict[str, dict[str, float]]:
    """Return for each row the time of PyTorch Geometric's layers over that of skin's."""
    found = {}
    for row, (graphs, sizes) in ROWS.items():
        cases = {
            f"{first} to {second}": (first, *convolutions(first, second, graphs))
            for first, second in pairwise(sizes)
        }
        cases |= {name: (sizes[-1], *poolings(name, sizes[-1], graphs)) for name in POOLINGS}
        ratios = {}
        for case, (width, ours, theirs) in cases.items():
            x = torch.randn(SENSORS, graphs, width)
            own, *others = _alternating([ours, *theirs.values()], x, repeats)
            for name, other in zip(theirs, others, strict=True):
                ratios[f"{case}: {name}"] = round(other / own, 2)
        found[row] = ratios
    return found


def _alternating(tasks: list[Task], x: Tensor, repeats: int) -> list[float]:
    """Return the median time of each task, s of the processor, over repeats in turns after two uncounted."""
    taken: list[list[float]] = [[] for _ in tasks]
    for _ in range(repeats + 2):
        for task, times in zip(tasks, taken, strict=True):
            nodes = x.clone().requires_grad_()
            began = time.process_time()
            result = task(nodes)
            result.backward(torch.ones_like(result))  # as large as it is: .sum() would give a single number
            times.append(time.process_time() - began)
    return [median(times[2:]) for times in taken]
