"""What every representation must do; readings as they are, as images, and as spectra of images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from scipy.spatial import Delaunay

from skin.body.base import GEOMETRY, Sheet
from skin.body.layout import Grid
from skin.core.files import CONF
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning import representation
from skin.learning.fusion import Early, Linked
from skin.learning.graph import Graph, adjacency, neighbours, normalised, typical_distance
from skin.learning.model import Gcn
from skin.learning.representation import Fourier, Image, Readings, Sites

# Interpolation against planes and brute force.
SIZE = (0.16, 0.12)


def image(positions, readings, **options):
    given = torch.tensor(readings)[None, None]
    represent = Image(torch.tensor(positions), (0.16, 0.08), **options)
    return represent(given, torch.ones_like(given, dtype=torch.bool)).x[0, 0, 0]


def test_x_is_the_column_and_y_the_row_also_on_an_oblong_sheet():
    picture = image([[0.15, 0.01, 0.0], [0.01, 0.07, 0.0]], [5.0, 10.0], pixels=16)
    assert picture[2, 15] == 0.5
    assert picture[14, 1] == 1.0
    assert picture.count_nonzero() == 2


@pytest.mark.parametrize("kind", [Fourier, Graph, Image, representation.Interpolation])
def test_three_axes_of_a_site_are_three_features_of_one_place(kind):
    """Each is what a skin with sensors along this axis alone shows; masks come behind all readings."""
    places = torch.tensor([[0.02, 0.01, 0.0], [0.05, 0.06, 0.0], [0.11, 0.03, 0.0], [0.15, 0.07, 0.0]])
    readings, valid = torch.randn(2, 5, 12), torch.rand(2, 5, 12) > 0.2
    alone, three = (kind(at, (0.16, 0.08), mask=True) for at in (places, places.repeat_interleave(3, 0)))
    frames = three(readings, valid)
    along = -1 if kind is Graph else 2
    parts = [alone(readings[..., axis::3], valid[..., axis::3]) for axis in range(3)]
    values, masks = zip(*(part.x.split(1, dim=along) for part in parts), strict=True)
    torch.testing.assert_close(frames.x, torch.cat([*values, *masks], dim=along))
    assert kind is not Graph or torch.equal(frames.adjacency, parts[0].adjacency)


def test_sensors_on_one_pixel_are_averaged():
    picture = image([[0.101, 0.041, 0.0], [0.1011, 0.0412, 0.0], [0.02, 0.02, 0.0]], [2.0, 4.0, 6.0])
    torch.testing.assert_close(picture[picture != 0].sort().values, torch.tensor([0.3, 0.6]))


def test_the_spectrum_is_that_of_numpy(made_up_device):
    touches = made_up_device.touches("test")[:3]
    given = touches.positions, made_up_device.size
    image = Image(*given, pixels=48)(touches.readings, touches.valid).x.double().numpy()
    wanted = np.log(1 + np.abs(np.fft.fftshift(np.fft.fft2(image), axes=(-2, -1))))
    spectrum = Fourier(*given, pixels=48)(touches.readings, touches.valid).x
    np.testing.assert_allclose(spectrum.numpy(), wanted, atol=1e-5)


def test_readings_then_their_mask():
    readings = torch.tensor([[[1.0, 2.0, 3.0]]])
    valid = torch.tensor([[[True, False, True]]])
    x = Readings(torch.zeros(3, 3), (0.16, 0.16), scale=2.0, mask=True)(readings, valid).x
    assert x.tolist() == [[[0.5, 0.0, 1.5, 0.0, 1.0, 0.0]]]


def test_both_views_of_one_newton_above_idle():
    readings = torch.zeros(1, 30, 5)
    readings[0, 20, 2] = 1.0
    represent = representation.Features(torch.rand(5, 3), (1.0, 1.0))
    x = represent(readings, torch.ones_like(readings, dtype=torch.bool)).x[0, 20]
    assert x[2] == pytest.approx(1 / 3)
    # asinh(1 / 0.2) = ln(5 + sqrt(26))
    assert x[5 + 2] == pytest.approx(2.3124383 / 2)
    assert x.count_nonzero() == 2


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform((0.01, 0.01), (0.15, 0.11), (20, 2))


@pytest.mark.parametrize(("method", "tolerance"), [("linear", 1e-12), ("cubic", 1e-8)])
def test_a_plane_is_reproduced_inside_the_hull(points, method, tolerance):
    def plane(xy):
        return 3 + 40 * xy[:, 0] - 70 * xy[:, 1]

    targets = representation.centres(SIZE, 64)
    inside = Delaunay(points).find_simplex(targets) >= 0
    values = representation.weights(points, targets, method) @ plane(points)
    assert inside.sum() > 1000
    assert np.abs(values - plane(targets))[inside].max() < tolerance


@pytest.mark.parametrize("method", ["linear", "cubic"])
def test_outside_the_hull_the_nearest_value_holds(points, method):
    targets = representation.centres(SIZE, 48)
    outside = Delaunay(points).find_simplex(targets) < 0
    assert outside.sum() > 100
    np.testing.assert_array_equal(
        representation.weights(points, targets, method)[outside],
        representation.weights(points, targets, "nearest")[outside],
    )


@pytest.fixture
def touches():
    """Five touches of nine sensors on a skin of 0.2 x 0.1 m; one sensor is dead in the first touch."""
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(5, 12, 9, generator=generator)
    sites = torch.rand(9, 2, generator=generator) * torch.tensor([0.2, 0.1])
    geometry = torch.rand(9, len(GEOMETRY), generator=generator)
    geometry[:, :2] = sites
    geometry[:, GEOMETRY.index("width")], geometry[:, GEOMETRY.index("height")] = 0.2, 0.1
    valid = torch.ones(5, 12, 9, dtype=torch.bool)
    valid[0, :, 3] = False
    positions = torch.cat([sites, torch.full((9, 1), 0.005)], dim=1)
    return Touches(readings, valid, positions, None, 10.0, geometry=geometry, saturated=readings > 0.98)


def shown(touches):
    return Sites(touches.positions, (0.2, 0.1)).show(touches)


def test_the_shape_does_not_depend_on_the_sensors(touches):
    frames = shown(touches)
    assert frames.x.shape == (5, 12, 36 * 3 * 4 + 2 * 10 + 2)
    assert frames.summary.shape == (5, 1 + 3 * len(GEOMETRY) + 36 * 3 + 107)
    assert torch.isfinite(frames.x).all()
    assert torch.isfinite(frames.summary).all()


def test_the_order_of_sensors_does_not_matter(touches):
    order = torch.randperm(9, generator=torch.Generator().manual_seed(1))
    series = {name: getattr(touches, name)[..., order] for name in ("readings", "valid", "saturated")}
    other = replace(touches, **series, positions=touches.positions[order], geometry=touches.geometry[order])
    for found, expected in zip(shown(other)[::2], shown(touches)[::2], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("filled", [0.0, 100.0])
def test_a_dead_sensor_changes_nothing(touches, filled):
    extra = torch.full((5, 12, 1), torch.nan)
    other = replace(
        touches,
        readings=torch.cat([touches.readings, extra], dim=2),
        valid=torch.cat([touches.valid, extra == 0], dim=2),
        saturated=torch.cat([touches.saturated, extra != extra], dim=2),
        positions=torch.cat([touches.positions, torch.zeros(1, 3)]),
        geometry=torch.cat([touches.geometry, filled * torch.ones(1, len(GEOMETRY))]),
    )
    for found, expected in zip(shown(other)[::2], shown(touches)[::2], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_each_touch_may_have_a_skin_of_its_own(touches):
    geometry = touches.geometry.expand(5, 9, len(GEOMETRY)).clone()
    each = replace(touches, positions=touches.positions.expand(5, 9, 3), geometry=geometry)
    torch.testing.assert_close(shown(each).x, shown(touches).x)
    each.geometry[2, :, 0] /= 2
    moved = (shown(each).x - shown(touches).x).abs().amax((1, 2))
    assert (moved > 1e-3).tolist() == [False, False, True, False, False]


def test_a_reading_appears_at_the_site_where_its_sensor_is(touches):
    readings = torch.zeros(1, 12, 9)
    readings[:, 11, 4] = 2.0
    valid = torch.ones(1, 12, 9, dtype=torch.bool)
    one = replace(touches[:1], readings=readings, saturated=None, valid=valid)
    linear = shown(one).x[0, 11, : 36 * 4].view(36, 4)[:, 0]
    x, y = one.positions[4, :2] / torch.tensor([0.2, 0.1])
    middles = (torch.arange(6) + 0.5) / 6
    sites = torch.stack(torch.meshgrid(middles, middles, indexing="xy"), -1)
    distance = (sites.flatten(0, 1) - torch.stack([x, y])).norm(dim=1)
    assert distance[linear.argmax()] < 0.35
    assert linear.max() <= 2.0 / 3.0 + 1e-6


def test_touches_of_unknown_mechanics_are_refused(touches):
    with pytest.raises(InputError, match="representation=sites needs to know what each sensor responds to"):
        shown(replace(touches, geometry=None))


# sites needs the geometry of sensors
OPTIONS = sorted(path for path in (CONF / "representation").glob("*.yaml") if path.stem != "sites")
CHANGES = {
    "interp": [{"method": "nearest"}, {"method": "cubic"}],
    "graph": [{"edges": "delaunay"}, {"weight": "stiffness"}],
}
VARIANTS = [(path, extra) for path in OPTIONS for extra in ({}, *CHANGES.get(path.stem, []))]


@pytest.fixture(params=VARIANTS, ids=lambda v: "-".join([v[0].stem, *v[1].values()]))
def make(request):
    path, extra = request.param
    around = {"body": OmegaConf.load(CONF / "body" / "sheet.yaml"), "option": OmegaConf.load(path)}
    option = OmegaConf.to_container(OmegaConf.create(around), resolve=True)["option"]
    return lambda *args, **changes: instantiate(option, **extra)(*args, **changes)


@pytest.fixture
def given(made_up_device):
    touches = made_up_device.touches("train")[:5]
    return touches.positions, made_up_device.size, touches.readings, touches.valid


@pytest.mark.parametrize("mask", [False, True])
def test_shapes_follow_the_kind(make, given, mask):
    positions, size, readings, valid = given
    representation = make(positions, size, mask=mask)
    x, adjacency, summary = representation(readings, valid)
    channels = 2 if mask else 1
    views = 1 if summary is None else 2
    wanted = {"image": (channels, 64, 64), "graph": (12, channels), "readings": (12 * (views + mask),)}
    assert x.shape == (5, 10, *wanted[representation.kind])
    assert x.dtype == torch.float32
    assert (adjacency is None) == (representation.kind != "graph")
    if adjacency is not None:
        assert adjacency.shape == (12, 12)


def test_an_invalid_reading_says_nothing(make, given):
    positions, size, readings, valid = given
    representation = make(positions, size)
    valid = valid.clone()
    valid[:, 3:5, 7] = False
    bad, zero = readings.clone(), readings.clone()
    bad[:, 3:5, 7], zero[:, 3:5, 7] = float("nan"), 0
    shown = representation(bad, valid).x
    assert torch.equal(shown, representation(zero, valid).x)
    if not representation.windowed:
        assert torch.equal(shown, representation(zero, torch.ones_like(valid)).x)


def test_touches_do_not_see_each_other(make, given):
    positions, size, readings, valid = given
    representation = make(positions, size)
    together = representation(readings, valid).x
    torch.testing.assert_close(representation(readings[2:3], valid[2:3]).x, together[2:3])
    part = representation(readings[:, 4:6], valid[:, 4:6]).x
    assert torch.allclose(part, together[:, 4:6], rtol=1e-4, atol=1e-5) == (not representation.windowed)


def test_gradients_reach_every_reading(make, given):
    positions, size, readings, valid = given
    readings = readings.clone().requires_grad_()
    make(positions, size)(readings, valid).x.square().sum().backward()
    assert (readings.grad != 0).all()


def test_one_sensor_is_enough_where_no_triangle_is_needed(make, given, request):
    _, size, readings, valid = given
    one = torch.tensor([[0.08, 0.06, 0.005]])
    if any(name in request.node.name for name in ("[interp]", "cubic", "delaunay")):
        with pytest.raises(InputError, match="at least three sensors"):
            make(one, size)
    else:
        assert torch.isfinite(make(one, size)(readings[..., :1], valid[..., :1]).x).all()


# a square of side 1, a point to its right, and one far away
#   0---1
#   |   |   4
#   2---3             5
POINTS = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [1.9, 0.6], [5, 1.1]]) * 0.01
POINTS = np.hstack([POINTS, np.zeros((6, 1))])
# 3-4 is shorter than 1-4 and 2-3 than 0-2; point 5 is nobody's neighbour, but has one
TIE_FREE = POINTS + 1e-4 * np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 3, 0], [0, 0, 0], [0, 0, 0]])
TILTED = POINTS + 1e-3 * np.outer(np.eye(6)[3], [1, 1, 0])  # 1-2 is then a Delaunay edge
BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
NINE = torch.from_numpy(Grid(3, 3).sensors(BODY).positions).float()


@pytest.mark.parametrize(
    ("points", "edges", "count", "expected"),
    [
        (TIE_FREE, "knn", 1, "01 23 34 45"),
        (POINTS, "knn", 2, "01 02 13 23 34 14 45 35"),
        (POINTS, "knn", 6, "01 02 03 04 05 12 13 14 15 23 24 25 34 35 45"),
        (TILTED, "delaunay", 6, "01 02 12 13 23 14 34 35 45 15"),
    ],
)
def test_neighbours(points, edges, count, expected):
    linked = neighbours(points, edges, count)
    assert {f"{i}{j}" for i, j in np.argwhere(linked) if i <= j} == set(expected.split())
    assert (linked == linked.T).all()


def test_weights_of_edges():
    points = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]) * 0.01
    linked = neighbours(points, "knn", 1)  # 0-1 and 1-2; the nearest are 1, 1 and 2 cm away: d0 = 1 cm
    for law, a, b in (("exp", np.exp(-1), np.exp(-2)), ("distance", 1, 2), ("none", 1, 1)):
        for unit in (1, 10):
            weights = adjacency(unit * points, linked, law)
            np.testing.assert_allclose(weights, [[0, a, 0], [a, 0, b], [0, b, 0]])


def test_normalised_by_hand():
    # rows of A + I sum to 3, 4 and 2
    edges = np.array([[0, 2, 0], [2, 0, 1], [0, 1, 0]])
    a, b = 2 / np.sqrt(12), 1 / np.sqrt(8)
    np.testing.assert_allclose(normalised(edges), [[1 / 3, a, 0], [a, 1 / 4, b], [0, b, 1 / 2]])


def test_coordinates_are_the_last_two_features():
    positions = torch.tensor([[0.04, 0.03, 0.005], [0.16, 0.12, 0.005], [0.0, 0.06, 0.005]])
    readings = torch.rand(2, 4, 3, generator=torch.Generator().manual_seed(0))
    valid = torch.ones_like(readings, dtype=torch.bool)
    x = Graph(positions, (0.16, 0.12), coordinates=True, mask=True)(readings, valid).x
    assert x.shape == (2, 4, 3, 4)
    torch.testing.assert_close(x[..., 0], readings / 10)
    torch.testing.assert_close(x[..., 2:], torch.tensor([[0.25, 0.25], [1, 1], [0, 0.5]]).expand(2, 4, 3, 2))


def moving(motion=None, positions=NINE):
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(2, 5, len(positions), generator=generator)
    return Touches(readings, readings >= 0, positions, torch.zeros(2, 4), 10.0, motion)


def moves(scale=0.004):
    return scale * torch.randn(2, 5, 9, 3, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("weight", ["exp", "distance", "stiffness"])
def test_a_frame_whose_sensors_moved_has_the_graph_of_where_they_are(weight):
    """Independent answer: the graph of each frame's places, made anew, with the layout's edges and d0."""
    graph = Graph(NINE, BODY.size, positions="deformed", weight=weight, count=3)
    motion = moves()
    x, matrices = graph.show(moving(motion))[:2]
    assert x.shape == (2, 5, 9, 1)
    assert matrices.shape == (2, 5, 9, 9)
    rest = NINE.double().numpy()
    linked, unit = neighbours(rest, "knn", 3), typical_distance(rest)
    for gesture in range(2):
        for frame in range(5):
            positions = rest + motion[gesture, frame].double().numpy()
            distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
            stiff = np.divide(unit, distance, out=np.zeros_like(distance), where=linked)
            law = {"exp": np.exp(-distance / unit), "distance": distance / unit, "stiffness": stiff}
            expected = normalised(linked * law[weight])
            np.testing.assert_allclose(matrices[gesture, frame].numpy(), expected, rtol=1e-5, atol=1e-7)


def test_a_deformed_graph_needs_to_know_the_motion():
    with pytest.raises(InputError, match=r"Touches\(motion=\.\.\.\), or set"):
        Graph(NINE, BODY.size, positions="deformed").show(moving())


@pytest.mark.parametrize("fusion", [Early, Linked])
def test_the_other_fusions_refuse_a_graph_per_frame(fusion):
    built = fusion(lambda kind, shape: Gcn(kind, shape, [6]), "graph", (9, 1), 5)
    with pytest.raises(InputError, match="one graph per frame needs fusion=late"):
        built(Graph(NINE, BODY.size, positions="deformed").show(moving(moves())))
