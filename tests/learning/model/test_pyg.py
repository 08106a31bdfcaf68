"""Networks of PyTorch Geometric on the graph of sensors."""

import torch
from torch_geometric.nn import DenseGCNConv
from torch_geometric.nn.models import GCN

from skin.learning.graph import Graph
from skin.learning.model import Pyg


def graphs(count=3):
    generator = torch.Generator().manual_seed(0)
    positions = 0.1 * torch.rand(9, 3, generator=generator)
    return torch.randn(count, 9, 2, generator=generator), Graph(positions, (0.16, 0.16)).adjacency


def test_one_layer_of_gcn_is_the_dense_product_with_the_adjacency():
    x, adjacency = graphs()
    model = Pyg("graph", (9, 2), GCN, width=4, layers=1, pooling="mean")
    convolution = model.network.convs[0]
    expected = (adjacency @ x @ convolution.lin.weight.T + convolution.bias).mean(dim=1)
    torch.testing.assert_close(model(x, adjacency), expected)
    assert not isinstance(convolution, DenseGCNConv)
