"""Settings are refused by name where they have the wrong type, are out of range, or are unknown."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from annotated_types import Ge, Gt, Le
from omegaconf import OmegaConf

from skin.core.settings import ONCE, RISING, check_groups, check_settings, checked, configured
from skin.errors import InputError
from skin.runs.build import build_data, build_device, build_learner

FIT = {"count": 2, "share": 1, "width": None, "kind": "b", "widths": [1, 2], "name": "x", "copies": {"a": 1}}
SMALL = ["simulator=naive", "data.gestures=20"]
SERIAL = ["device=serial", "device.port=/dev/null"]


class Thing:
    def __init__(
        self,
        made: Callable[..., Any],
        count: Annotated[int, Ge(1)] = 1,
        share: float = 0.5,
        width: Annotated[float, Gt(0)] | None = None,
        kind: Literal["a", "b"] = "a",
        widths: Sequence[int] = (),
        first: Annotated[int, Ge(1)] | Literal["idle"] | None = None,
        name: str = "",
        on: bool = False,
        where: Literal["out"] | Annotated[int, Le(9)] | None = None,
        copies: Mapping[str, int] | None = None,
        span: Annotated[tuple[float, float], RISING] = (1, 10),
        labels: Annotated[Sequence[str], ONCE] = (),
    ) -> None:
        pass


def test_what_fits_is_taken():
    check_settings(Thing, {**FIT, "_partial_": True, "made": {"_target_": "anything"}}, "thing")
    check_settings(Thing, {"count": np.int64(2), "share": np.float32(0.5), "span": (1, 2.5)}, "thing")
    composed = OmegaConf.create({"span": [1, 2.5], "copies": {"a": 1}})
    check_settings(Thing, {name: composed[name] for name in composed}, "thing")
    check_settings(lambda **settings: None, {"anything": 1}, "thing")
    # classes of libraries check themselves
    check_groups({"learner": {"optimizer": {"_target_": "torch.optim.Adam", "no": "such setting"}}})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"count": 0}, "thing.count=0 must be greater than or equal to 1"),
        ({"count": 0.5}, "thing.count=0.5 must be a whole number"),
        ({"count": "2"}, "thing.count=2 must be a whole number, not text"),
        ({"share": float("nan")}, "thing.share=nan must be a finite number"),
        ({"where": "in"}, "thing.where=in must be 'out'"),
        ({"first": {"rows": 2}}, "thing.first={'rows': 2} must be a whole number or 'idle'$"),
        ({"widths": 8}, "thing.widths=8 must be a list"),
        ({"share": -1j}, "thing.share=.*: as in thing.share=0.5$"),
        ({"span": [2, 1]}, r"thing.span=\[2, 1\] must be a range .*: as in thing.span=\[1,10\]$"),
        ({"span": [1, 2, 3]}, r"thing.span=\[1, 2, 3\] has too many entries"),
        ({"labels": ["a", "b", "a"]}, r"thing.labels=\['a', 'b', 'a'\] must hold each name once"),
        ({"widths": [0.5] * 50}, r"thing.widths=.{80} must be a whole number"),
        ({"shar": 1}, "thing has no setting shar: did you mean share[?] it has count, share, width"),
        ({1: 2}, "thing has no setting 1: it has count"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(wrong, said):
    with pytest.raises(InputError, match=f"^{said}"):
        check_settings(Thing, FIT | wrong, "thing")


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ({"_target_": f"{__name__}.Thing", "count": 0}, "model.count=0 must be greater"),
        ({"_target_": "absent.Thing"}, "model._target_=absent.Thing cannot be imported: .*'absent'"),
        ({"_target_": "skin.learning.model.Mpl"}, "model._target_=skin.learning.model.Mpl cannot be"),
    ],
)
def test_classes_of_others_are_checked_too(part, said):
    with pytest.raises(InputError, match=f"^{said}"):
        check_groups({"learner": {"model": part}})


def test_settings_that_are_all_are_missed_by_name():
    with pytest.raises(InputError, match=r"^thing needs made, got count$"):
        configured(Thing, {"count": 1}, "thing")
    with pytest.raises(InputError, match=r"^thing has no setting mad: did you mean made"):
        configured(Thing, {"mad": 1}, "thing")


def test_a_checked_class_refuses_what_a_script_gives_it():
    @checked("pair")
    class Pair:
        def __init__(self, first: Annotated[int, Ge(1)], second: float = 0.5) -> None:
            self.sum = first + second

    assert Pair(1, second=2).sum == 3
    for given in ({"first": 0}, {"first": 1.5}, {"first": 1, "second": "x"}):
        with pytest.raises(InputError, match=r"^pair[.]"):
            Pair(**given)
    with pytest.raises(TypeError, match="third"):
        Pair(1, third=2)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["optimizer.lr=oops"], "optimizer.lr=oops is text"),
        (["+optimizer.lrr=1"], "the optimizer refuses its settings: .*lrr"),
        (["+model.channelz=3"], "model has no setting channelz: did you mean channels"),
        (["trainer.accelerator=gpus"], "Trainer refuses trainer: .*gpus"),
        (["learner=boosted_trees", "learner.rounds=0"], "learner.rounds=0 must be greater than or equal"),
        (["device.noise=-1"], "device.noise=-1 must be greater than or equal to 0"),
        (["device.dead=[4,2]"], r"device.dead=\[4, 2\] must be a range \[minimum, maximum\]"),
        (["+device.noize=1"], "no setting noize: did you mean noise[?] it has .*gain_spread, scale_spread, "),
        ([*SERIAL, "device.limits=[1023,0]"], r"device.limits=\[1023, 0\] must be \[smallest, largest\]"),
    ],
)
def test_a_group_refuses_a_setting_before_anything_is_made(configured, overrides, said):
    config = configured(*SMALL, *overrides)
    with pytest.raises(InputError, match=said):
        build_learner(config).check(build_data(config, build_device(config)))
