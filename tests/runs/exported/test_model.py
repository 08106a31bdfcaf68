"""Files that are not what an exported model must be."""

import json

import numpy as np
import pytest

from skin.errors import InputError
from skin.runs.model import KEY, ModelMetadata, OnnxModel

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def test_it_describes_itself(exported):
    of, path = exported
    about = OnnxModel(path).metadata
    assert about.task == of.device.task
    assert (about.rate, about.window, len(about.positions)) == (10.0, 30, 6)
    assert (about.run, about.contact, about.saturation) == ("none", 0.3, 10.0)
    entry = {one.key: one.value for one in onnx.load(path).metadata_props}[KEY]
    assert json.loads(entry)["schema"] == 1
    assert json.loads(entry)["sensors"] == 6


def test_one_window_has_one_number_per_label(exported):
    of, path = exported
    touches = of.device.touches("test")[:1]
    window = touches.readings[0].numpy(), touches.valid[0].numpy()
    np.testing.assert_allclose(
        OnnxModel(path).probabilities(*(part[None] for part in window))[0],
        of.learner.probabilities(touches)[0].numpy(),
        atol=1e-5,
    )


def changed(path, folder, change):
    """Return a copy of a model with a changed description."""
    model = onnx.load(path)
    (entry,) = [one for one in model.metadata_props if one.key == KEY]
    known = json.loads(entry.value)
    change(known)
    entry.value = json.dumps(known)
    onnx.save(model, folder / "changed.onnx")
    return folder / "changed.onnx"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda known: known.update(schema=2), "has schema 2, this version reads 1"),
        (lambda known: known.pop("schema"), "damaged description"),
        (lambda known: known.update(rate="fast"), "rate=fast"),
        (lambda known: known.update(labels=[]), "labels"),
        (lambda known: known.update(sensors=7), "6 positions for 7 sensors"),
        (lambda known: known.update(window=20), "not readings .float. and valid .bool. of"),
    ],
)
def test_a_wrong_description_is_refused(exported, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        OnnxModel(changed(exported[1], tmp_path, change))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="there is no file"):
        OnnxModel(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(InputError, match="ONNX Runtime cannot load"):
        OnnxModel(tmp_path / "text.onnx")
    with pytest.raises(InputError, match="was not written by skin export"):
        ModelMetadata.parse({}, "x.onnx")
