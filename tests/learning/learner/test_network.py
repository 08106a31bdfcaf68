"""Training by gradient descent."""

import pytest
import torch
from hydra.utils import instantiate
from pytorch_lightning.loggers import CSVLogger

from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.fusion import Early, Late
from skin.learning.model import Mlp
from skin.learning.training import Progress
from skin.runs.build import build_learner

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
        ("model=gcn", "model=gcn needs representation=graph, got image: add representation=graph"),
        ("representation=graph", "model=cnn needs representation=image, got graph: add representation=image"),
        ("fusion=linked", "fusion=linked needs representation=graph, got image: add .*graph model=gcn"),
        ("fusion.head=sum", "fusion.head=sum must be 'mean', .*'gru', .*'residual' or 'transformer'"),
        ("fusion.head=transformer fusion.hidden=30", r"got fusion\.hidden=30: set fusion\.hidden=32"),
        ("fusion.hidden=0", "fusion.hidden=0 must be greater than 0: as in fusion.hidden=64"),
        ("model.channels=[8,8,8,8,8,8]", r"6 blocks from an image of 64 x 64 pixels: set model\.channels"),
        ("model=efficientnet model.weights=random fusion=early", "1 or 3 channels, got 10: set fusion=late"),
        (f"{GRAPH} model.widths=[]", r"model.widths=\[\] has too few"),
        (f"{GRAPH} model.pooling=set3set", "model.pooling=set3set must be 'max', .* or 'set2set'"),
        (f"{GRAPH} model.norm=group", "model.norm=group must be 'none', 'layer', 'batch' or 'instance'"),
        (f"{GRAPH} model.activation=tanh", "model.activation=tanh must be 'relu', 'elu' or 'silu'"),
        (f"{PYG} +model.network.headz=4", "model.network refuses its settings: .*headz"),
        ("representation=graph model=transformer model.width=10", "got model.width=10: set model.width=12"),
        ("representation=graph model=transformer model.layers=0", "model.layers=0 must be greater than 0"),
        (f"{GRAPH} representation.edges=ring", "representation.edges=ring must be 'knn' or 'delaunay'"),
        (f"{GRAPH} representation.count=0", "representation.count=6"),
        (f"{GRAPH} representation.positions=deformed representation.weight=none", "changes nothing at"),
        ("representation=interp representation.method=[]", r"^representation\.method=.*: as in .*=linear$"),
        ("representation=interp representation.method=[nearest,quintic]", "quintic.*: as in .*=linear$"),
        ("representation.pixels=7", r"representation\.pixels=64"),
        ("learner.activation=sine", "learner.activation=sine must be 'relu', 'elu' or 'silu'"),
        ("learner.hidden=[8,0]", r"learner.hidden=\[8, 0\] must be greater than or equal to 1"),
        ("learner.hidden=8", "learner.hidden=8 must be a list"),
        ("learner.dropout=1", "learner.dropout=1 must be less than 1"),
        ("learner.warmup=-0.1", "learner.warmup=-0.1 must be greater than or equal to 0"),
        ("trainer.max_epochs=1.5", "trainer.max_epochs=1.5 must be a whole number from 1 up"),
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
    forward = Mlp.forward
    monkeypatch.setattr(Mlp, "forward", lambda *arguments: forward(*arguments) * float("nan"))
    with pytest.raises(InputError, match=r"the loss is nan: lower optimizer\.lr"):
        learner.fit(data)


@pytest.mark.parametrize(
    ("fusion", "part"), [("early", Mlp), ("late", Mlp), ("early", Early), ("late", Late)]
)
def test_an_embedding_that_is_not_as_wide_as_it_says_is_refused(build, monkeypatch, fusion, part):
    learner, data = build("representation=readings", "model=mlp", f"fusion={fusion}")
    learner.check(data)
    forward = part.forward
    monkeypatch.setattr(part, "forward", lambda *arguments: forward(*arguments)[:, 1:])
    with pytest.raises(InputError, match=r"as wide as their attribute width says: .*\d"):
        learner.check(data)


def test_readings_of_another_number_of_sensors_are_refused(build, made_up_device):
    learner, data = build("representation=readings", "model=mlp", "trainer.max_epochs=1")
    learner.fit(data)
    touches = made_up_device.touches("test")
    fewer = type(touches)(
        touches.readings[..., :9], touches.valid[..., :9], touches.positions[:9], touches.labels, 10.0
    )
    with pytest.raises(
        InputError, match="12 readings per frame, got 9: train with representation=graph or image"
    ):
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
