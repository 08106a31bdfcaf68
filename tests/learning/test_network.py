"""Training by gradient descent: its steps and losses, and the sizes of the report's five systems."""

import math

import pytest
import torch
from hydra.utils import instantiate
from pytorch_lightning.loggers import CSVLogger

from skin.body.layout import Scattered
from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.fusion import AbstractFusion, Early, Late
from skin.learning.model import Mlp
from skin.learning.network import TouchClassifier, probabilities
from skin.learning.representation import Frames
from skin.learning.training import Progress, Training
from skin.runs.build import build_learner
from skin.touch.labels import TOUCH, TOUCH_OR_NOT, Task

GESTURES = Task(("grab", "hit", "stroke"), "exclusive")
PLACE = Task(("x", "force"), "regression")


class Flat(AbstractFusion):
    """Passes readings (B, T, F) on as they are, flattened."""

    width = 6

    def forward(self, frames: Frames) -> torch.Tensor:
        return frames.x.flatten(1)


def classifier(task=TOUCH, hidden=(5,)):
    torch.manual_seed(0)
    return TouchClassifier(Flat(), task, hidden, "relu")


@pytest.mark.parametrize(
    ("row", "parameters"),
    [
        ("linked_graph", 196),
        ("temporal_graph", 145_774),
        ("temporal_image", 209_844),
        ("sequence_graph", 105_621),
        ("sequence_image", 1_634_341),
    ],
)
def test_the_rows_have_the_parameters_of_the_report(row, parameters, configured):
    config = configured(f"experiment={row}")
    body = instantiate(config.body)
    positions = torch.from_numpy(Scattered(5, 5, seed=1).sensors(body).positions).float()
    readings = torch.zeros(1, 30, 25)

    class Device(AbstractDevice):
        task, size = TOUCH, body.size

        def touches(self, split, epoch=0):
            return Touches(readings, readings == 0, positions, torch.zeros(1, 4), 10.0)

    learner = instantiate(config.learner)
    network = learner.build(TouchData(Device(), instantiate(config.representation)))
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters
    assert learner.parameters == parameters
    if row == "sequence_image":
        assert network.fusion.model.convolutions[0].weight.shape == (8, 3, 3, 3)


def test_the_loss_of_exclusive_labels_by_hand():
    logits = torch.tensor([[1.0, 0.0, 0.0]])
    loss = classifier(GESTURES).loss(logits, torch.tensor([[0.0, 1.0, 0.0]]))
    assert loss.item() == pytest.approx(math.log(math.e + 2))
    assert probabilities(logits, GESTURES).sum().item() == pytest.approx(1)


def test_without_touch_only_the_gate_learns():
    logits = torch.tensor([[0.0, 2.0, -1.0, 0.0, 3.0], [5.0, -4.0, 3.0, 2.0, 1.0]], requires_grad=True)
    labels = torch.tensor([[1.0, 1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    loss = classifier(TOUCH_OR_NOT).loss(logits, labels)
    touched = 2 * math.log(2) + math.log1p(math.exp(-2)) + math.log1p(math.exp(-1))
    gates = math.log1p(math.exp(-3)) + math.log1p(math.exp(1))
    assert loss.item() == pytest.approx((touched + gates) / 6)
    loss.backward()
    assert logits.grad[1, :4].tolist() == [0.0] * 4
    assert (logits.grad[0] != 0).all()
    assert logits.grad[1, 4] > 0


def test_what_an_epoch_logs(monkeypatch):
    network = classifier(hidden=())
    training, logged = Training(network, None, torch.optim.Adam), {}
    monkeypatch.setattr(training, "log", lambda name, value, **_: logged.update({name: value.item()}))
    with torch.no_grad():
        network.head[0].weight.zero_()
        network.head[0].bias.copy_(torch.tensor([1.0, 1.0, -1.0, -1.0]))
    labels = torch.tensor([[1.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0]])
    for _ in range(2):
        # Batches count by their size; the next epoch begins anew.
        for batch in (labels[:2], labels[2:]):
            training.validation_step((Frames(torch.randn(len(batch), 3, 2), None), batch), 0)
        training.on_validation_epoch_end()
        thirds = {"big": 2, "dynamic": 2, "press": 3, "dangerous": 1}
        assert {name: 3 * logged.pop(f"val_accuracy_{name}") for name in thirds} == pytest.approx(thirds)
        assert logged.pop("val_accuracy") == pytest.approx(8 / 12)
        right, wrong = math.log1p(math.exp(-1)), math.log1p(math.exp(1))
        assert logged.pop("val_loss") == pytest.approx((8 * right + 4 * wrong) / 12)
        assert not logged


@pytest.mark.parametrize(("step", "fraction"), [(0, 0.04), (19, 1.0), (99, 0.0)])
def test_the_learning_rate_rises_and_falls(step, fraction):
    training = Training(classifier(), None, torch.optim.Adam, warmup=0.2)
    training._trainer = type("Trainer", (), {"estimated_stepping_batches": 100})()
    chosen = training.configure_optimizers()
    assert chosen["lr_scheduler"]["interval"] == "step"
    for _ in range(step):
        chosen["optimizer"].step()
        chosen["lr_scheduler"]["scheduler"].step()
    # it begins at a 25th of the optimizer's own rate
    assert chosen["optimizer"].param_groups[0]["lr"] == pytest.approx(1e-3 * fraction, abs=1e-6)


def test_what_is_learnt_in_few_batches_holds_in_use_whatever_the_unit():
    torch.manual_seed(0)
    network = TouchClassifier(Flat(), TOUCH, (5,), "relu", summary=3)
    x, summary = torch.randn(512, 3, 2), 1e-3 * torch.randn(512, 3) + 5e-3
    learning = torch.cat([network(Frames(x[i], None, summary[i])) for i in torch.arange(512).split(128)])
    torch.testing.assert_close(network.eval()(Frames(x, None, summary)), learning, rtol=0.1, atol=0.1)


def test_the_loss_of_targets_is_relative_to_their_deviation():
    network = classifier(PLACE)
    network.targets.scale(torch.tensor([[0.0, 10.0], [0.02, torch.nan], [0.01, 30.0]]))
    assert network.targets.mean.tolist() == pytest.approx([0.01, 20.0])
    predicted = torch.tensor([[0.01, 20.0], [0.03, 0.0]])
    labels = torch.tensor([[0.01, 25.0], [0.01, torch.nan]])
    wanted = (0.5**2 + (0.02 / network.targets.deviation[0].item()) ** 2) / 3
    assert network.loss(predicted, labels).item() == pytest.approx(wanted)
    assert network(Frames(torch.zeros(1, 3, 2), None))[0, 1].item() == pytest.approx(20, abs=10)
    assert torch.equal(probabilities(predicted, PLACE), predicted)


@pytest.mark.parametrize("task", [TOUCH, TOUCH_OR_NOT, GESTURES, PLACE])
def test_unknown_labels_have_no_loss_and_no_gradient(task):
    """The loss is that of the touches whose labels are known; without any, it is 0."""
    network = classifier(task)
    frames = Frames(torch.randn(6, 3, 2, generator=torch.Generator().manual_seed(1)), None)
    labels = torch.nn.functional.one_hot(torch.arange(6) % len(task), len(task)).float()
    if task.gate:
        labels[:, task.names.index(task.gate)] = 1.0
    unknown = labels.clone()
    unknown[4:] = torch.nan
    known = Frames(frames.x[:4], None)
    expected = network.loss(network(known), labels[:4])
    torch.testing.assert_close(network.loss(network(frames), unknown), expected)
    nothing = network.loss(network(frames), torch.full_like(labels, torch.nan))
    nothing.backward()
    assert nothing.item() == 0
    assert all(not parameter.grad.any() for parameter in network.parameters())
    fractions = (network.accuracy(network(known), labels[:4]), network.accuracy(network(frames), unknown))
    torch.testing.assert_close(fractions[1], fractions[0])


DENSE = ("representation=readings", "model=mlp", "fusion=early")


@pytest.fixture
def build(configured, made_up_device):
    """Return a function of overrides that returns the learner and the data of a made-up device."""

    def make(*overrides):
        config = configured(*overrides)
        return build_learner(config), TouchData(made_up_device, instantiate(config.representation), 32)

    return make


def curve(folder):
    """Return the logged losses of validation and training by epoch."""
    lines = (folder / "lightning_logs" / "version_0" / "metrics.csv").read_text().splitlines()
    names = lines[0].split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in lines[1:]]
    return ([float(row[name]) for row in rows if row[name]] for name in ("val_loss", "train_loss"))


def test_the_weights_of_the_best_validation_loss_are_kept(build, made_up_device, tmp_path):
    learner, data = build(*DENSE, "optimizer.lr=0.1", "trainer.max_epochs=12")
    learner.fit(data, CSVLogger(tmp_path))
    validation, _ = curve(tmp_path)
    assert min(validation) < validation[-1]  # a rate so high that the last epoch is not the best
    touches = made_up_device.touches("validation")
    probability = learner.probabilities(touches)
    loss = torch.nn.functional.binary_cross_entropy(probability, touches.labels)
    assert loss.item() == pytest.approx(min(validation), rel=1e-4)


GRAPH, PYG = "representation=graph model=gcn", "representation=graph model=pyg"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ("fusion=linked", "fusion=linked needs representation=graph, got image: add .*graph model=gcn"),
        ("fusion.head=sum", "fusion.head=sum must be 'mean', .*'gru', .*'residual' or 'transformer'"),
        ("fusion.head=transformer fusion.hidden=30", r"got fusion\.hidden=30: set fusion\.hidden=32"),
        ("model.channels=[8,8,8,8,8,8]", r"6 blocks from an image of 64 x 64 pixels: set model\.channels"),
        ("model=efficientnet model.weights=random fusion=early", "1 or 3 channels, got 10: set fusion=late"),
        (f"{PYG} +model.network.headz=4", "model.network refuses its settings: .*headz"),
        ("representation=graph model=transformer model.width=10", "got model.width=10: set model.width=12"),
        (f"{GRAPH} representation.positions=deformed representation.weight=none", "changes nothing at"),
        ("representation=interp representation.method=[nearest,quintic]", "quintic.*: as in .*=linear$"),
        ("trainer.precision=bf16-true", "give 32-true, 16-mixed or bf16-mixed"),
    ],
)
def test_choices_that_do_not_fit_are_refused(overrides, words, configured, made_up_device):
    config = configured(*overrides.split())
    data = TouchData(made_up_device, instantiate(config.representation))
    with pytest.raises(InputError, match=words):
        build_learner(config).fit(data)


def test_a_model_whose_answers_are_not_numbers_is_refused(build, monkeypatch):
    learner, data = build(*DENSE, "trainer.max_epochs=1")
    broken = lambda *given, forward=Mlp.forward: forward(*given) / given[0].training  # noqa: E731
    monkeypatch.setattr(Mlp, "forward", broken)
    with pytest.raises(InputError, match=r"the loss is nan: lower optimizer\.lr"):
        learner.fit(data)


@pytest.mark.parametrize(
    ("fusion", "part"), [("early", Mlp), ("late", Mlp), ("early", Early), ("late", Late)]
)
def test_an_embedding_that_is_not_as_wide_as_it_says_is_refused(build, monkeypatch, fusion, part):
    learner, data = build("representation=readings", "model=mlp", f"fusion={fusion}")
    forward = part.forward
    for wrong in ((slice(None), slice(1, None)), (slice(None), None)):
        monkeypatch.setattr(part, "forward", lambda *given, wrong=wrong: forward(*given)[wrong])
        with pytest.raises(InputError, match=r"as wide as their attribute width says: .*\d"):
            learner.check(data)


def test_readings_of_another_number_of_sensors_are_refused(build, made_up_device):
    learner, data = build("representation=readings", "model=mlp", "trainer.max_epochs=1")
    learner.fit(data)
    touches = made_up_device.touches("test")
    parts = touches.readings[..., :9], touches.valid[..., :9], touches.positions[:9]
    fewer = Touches(*parts, touches.labels, 10.0)
    with pytest.raises(InputError, match="12 readings per frame, got 9: train with representation=graph"):
        learner.probabilities(fewer)


@pytest.mark.parametrize(
    "overrides",
    [
        ["representation=image", "model=cnn"],
        ["representation=graph", "model=gcn", "model.norm=batch", "fusion=early"],
        ["representation=graph", "model=pyg"],
        ["representation=features", "model=mlp", "fusion.head=residual"],
        ["representation=graph", "model=transformer", "fusion.head=transformer"],
    ],
)
def test_it_trains_with_half_of_the_bits(build, made_up_device, overrides):
    learner, data = build(*overrides, "trainer.max_epochs=1", "trainer.precision=bf16-mixed")
    learner.fit(data)
    found = learner.probabilities(made_up_device.touches("test"))
    assert found.dtype == torch.float32
    assert found.isfinite().all()


def test_a_training_goes_on_from_weights(build, tmp_path):
    words = *DENSE, "trainer.max_epochs=1"
    first, data = build(*words)
    first.fit(data)
    path = first.save(tmp_path)
    second, data = build(*words, f"learner.start={path}", "optimizer.lr=1e-12")
    second.fit(data)
    for name, weights in second.network.state_dict().items():
        torch.testing.assert_close(weights, first.network.state_dict()[name], rtol=0, atol=1e-6)
    for start, words in ((tmp_path / "none.pt", "no such file"), (path, "of another network")):
        other, data = build("representation=readings", "model=mlp", f"learner.start={start}")
        with pytest.raises(InputError, match=words):
            other.check(data)


def test_progress_from_a_checkpoint_of_a_complete_training_knows_its_epochs(tmp_path):
    progress = Progress(tmp_path / "seconds.json")
    progress.load_state_dict({"seconds": [1.0, 5.0, 2.0], "state": None})
    assert progress.median() == 2.0
