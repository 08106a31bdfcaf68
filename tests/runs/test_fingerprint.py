"""A run is the same one on another machine."""

import pytest

from skin.runs.configuration import config_hash, fingerprint


@pytest.mark.parametrize(
    "overrides",
    [
        ["trainer.precision=bf16-mixed"],
        ["trainer.devices=2", "trainer.strategy=ddp", "+trainer.num_nodes=2"],
        ["trainer.accelerator=gpu"],
        ["+trainer.enable_progress_bar=true"],
        ["tracking.threads=1"],
    ],
)
@pytest.mark.parametrize("learner", ["network", "ensemble"])
def test_the_machine_makes_no_other_run(configured, overrides, learner):
    assert fingerprint(configured(f"learner={learner}", *overrides)) == fingerprint(
        configured(f"learner={learner}")
    )


def test_a_data_set_counts_by_its_manifest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hashes = []
    for manifest in (None, "one", "other"):
        if manifest:
            (tmp_path / "touches").mkdir(exist_ok=True)
            (tmp_path / "touches" / "manifest.json").write_text(manifest)
        hashes.append({config_hash({"path": path}) for path in ("touches", "./touches")})
    assert len(set.union(*hashes)) == 6
