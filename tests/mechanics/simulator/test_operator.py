"""The operator on disk: built once, and never trusted."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skin.body.base import Sensors, Sheet
from skin.mechanics.simulator import fem as _operator
from skin.mechanics.simulator.fem import Structure, build, cached

ECOFLEX = {"material": "EcoFlex 00-30", "thickness": 0.005}
STRUCTURE = Structure(Sheet([0.04, 0.03], [4, 3], [ECOFLEX]))
SENSORS = Sensors(np.array([[0.01, 0.02, 0.0], [0.03, 0.01, 0.0]]), (0.01, 0.01))


def same(first, second) -> bool:
    return all(np.array_equal(vars(first)[name], vars(second)[name]) for name in vars(first))


@pytest.fixture
def built(monkeypatch) -> list:
    calls: list = []

    def counted(*args):
        calls.append(args)
        return build(*args)

    monkeypatch.setattr(_operator, "build", counted)
    return calls


def stored(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_it_is_built_once_without_noise(tmp_path, built, recwarn):
    first, second = (cached(STRUCTURE, SENSORS, tmp_path) for _ in range(2))
    assert not recwarn
    assert len(built) == 1
    assert same(first, second)
    assert same(first, build(STRUCTURE, SENSORS))


def _rewrite(**changes):
    def damage(path: Path) -> None:
        with np.load(path) as file:
            arrays = dict(file)
        arrays |= {name: change(arrays[name]) for name, change in changes.items()}
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})

    return damage


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "a flipped byte": _flip,
    "another key": _rewrite(key=lambda _: np.array("0" * 64)),
    "a row missing": _rewrite(surface=lambda _: None),
    "another shape": _rewrite(sensor=lambda rows: rows[:, :-1]),
    "another type": _rewrite(sensor=lambda rows: rows.astype(np.float32)),
    "NaN": _rewrite(carried=lambda rows: rows * np.nan),
    "objects": _rewrite(sensor=lambda rows: rows.astype(object)),
    "a bare array": lambda path: np.save(path.open("wb"), np.zeros(3)),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_file_that_is_not_right_is_rebuilt(damage, tmp_path, built):
    first = cached(STRUCTURE, SENSORS, tmp_path)
    damage(stored(tmp_path))
    assert same(cached(STRUCTURE, SENSORS, tmp_path), first)
    assert len(built) == 2
    assert same(cached(STRUCTURE, SENSORS, tmp_path), first)
    assert len(built) == 2


def other_body(**changes):
    return replace(STRUCTURE, body=replace(STRUCTURE.body, **changes)), SENSORS


LAYER = STRUCTURE.body.layers[0]
OTHERS = {
    "size": other_body(size=(0.04, 0.031)),
    "cells": other_body(cells=(3, 4)),
    "thickness": other_body(layers=(replace(LAYER, thickness=0.006),)),
    "young": other_body(layers=(replace(LAYER, material=replace(LAYER.material, young=1e5)),)),
    "poisson": other_body(layers=(replace(LAYER, material=replace(LAYER.material, poisson=0.3)),)),
    "constraint": (replace(STRUCTURE, constraint="free"), SENSORS),
    "positions": (STRUCTURE, replace(SENSORS, positions=SENSORS.positions + 1e-6)),
    "order": (STRUCTURE, replace(SENSORS, positions=SENSORS.positions[::-1])),
    "footprint": (STRUCTURE, replace(SENSORS, footprint=(0.01, 0.011))),
}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS.keys())
def test_everything_it_depends_on_makes_another_file(other, tmp_path, built):
    cached(STRUCTURE, SENSORS, tmp_path)
    cached(*other, tmp_path)
    assert len(built) == len(list(tmp_path.iterdir())) == 2


def test_many_may_write_at_once(tmp_path):
    answers = []
    start = threading.Barrier(8)

    def work() -> None:
        start.wait()
        answers.append(cached(STRUCTURE, SENSORS, tmp_path))

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 8
    assert all(same(answer, answers[0]) for answer in answers)
    assert stored(tmp_path).suffix == ".npz"


def test_a_folder_that_cannot_be_written_to_costs_a_warning(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.warns(RuntimeWarning, match="the operator cannot be kept in"):
        operator = cached(STRUCTURE, SENSORS, blocked / "below")
    assert same(operator, build(STRUCTURE, SENSORS))
