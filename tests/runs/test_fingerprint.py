"""A run is the same one on another machine."""

from copy import deepcopy
from dataclasses import replace

import pytest

from skin.runs.configuration import ADDED, fingerprint, settings_hash


@pytest.mark.parametrize(
    ("overrides", "same"),
    [
        (["tracking.uri=sqlite:///elsewhere.db", "tracking.resume=false", "tracking.threads=1"], True),
        (
            ["trainer.precision=bf16-mixed", "trainer.accelerator=gpu", "+trainer.enable_progress_bar=true"],
            True,
        ),
        (["trainer.devices=2", "trainer.strategy=ddp", "+trainer.num_nodes=2"], True),
        *(
            ([word], False)
            for word in ("seed=1", "simulator=naive", "device.noise=0.06", "trainer.max_epochs=3")
        ),
    ],
)
@pytest.mark.parametrize("learner", ["network", "ensemble"])
def test_only_what_results_depend_on_changes_the_fingerprint_and_not_the_machine(
    configured, overrides, same, learner
):
    plain = f"learner={learner}"
    assert (fingerprint(configured(plain, *overrides)) == fingerprint(configured(plain))) == same


def test_a_changed_layout_file_changes_the_fingerprint(configured, tmp_path):
    path, prints = tmp_path / "sensors.csv", []
    for y in (0.05, 0.05, 0.06):
        path.write_text(f"x_m,y_m\n0.05,{y}\n")
        prints.append(fingerprint(configured(f"layout.path={path}")))
    assert prints[0] == prints[1] != prints[2]


@pytest.mark.parametrize("device", ["simulated", "skins"])
@pytest.mark.parametrize("profile", ["mild", "rough", "harsh", "calibrated", "drawn"])
def test_settings_that_came_later_make_no_other_run(configured, device, profile):
    """A run that finished before them has their values without naming them, and is found again."""
    config = configured(f"device={device}", f"profile={profile}")
    former = deepcopy(config)
    groups = [former.device, former.device.get("skins", {}), former.device["touch"], former.touch]
    missing = [{name: group.pop(name) for name in ADDED if name in group} for group in groups]
    assert set().union(*missing) >= {"scale_spread", "independent", "aligned", "framed", "second"}
    assert all(value == ADDED[name] for group in missing for name, value in group.items())
    assert fingerprint(config) == fingerprint(former)
    others = {"scale_spread": 0.1, "independent": True, "aligned": False, "framed": 0.1}
    for name, value in others.items():
        assert fingerprint(replace(former, device=former.device | {name: value})) != fingerprint(former)


def test_a_data_set_counts_by_its_manifest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hashes = []
    for manifest in (None, "one", "other"):
        if manifest:
            (tmp_path / "touches").mkdir(exist_ok=True)
            (tmp_path / "touches" / "manifest.json").write_text(manifest)
        hashes.append({settings_hash({"path": path}) for path in ("touches", "./touches")})
    assert len(set.union(*hashes)) == 6
