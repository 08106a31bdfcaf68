"""The paired difference is that of runs with the rows' present settings."""

import pytest

from skin.config import checked, fingerprint
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, configured):
    """A store with runs of two rows: 90, 92, 94 against 88, 89, 92 %, and one of other settings."""
    folder = tmp_path_factory.mktemp("paired")
    uri = f"tracking.uri=sqlite:///{folder}/m.db"
    made = [("rules", seed, 0.90 + 0.02 * seed, ()) for seed in range(3)]
    made += [("features", seed, value, ()) for seed, value in enumerate((0.88, 0.89, 0.92))]
    made += [("features", 0, 0.10, ("learner.rounds=3",))]
    for row, seed, value, settings in made:
        config = checked(configured(f"experiment={row}", f"seed={seed}", uri, *settings))
        store = Store.open(config.tracking)
        tags = {"fingerprint": fingerprint(config), "row": row, "simulator": "fem", "seed": str(seed)}
        with store.run("made up", tags) as run:
            store.log_metrics(run, {"same/overall/accuracy": value})
    return folder


def test_the_difference_has_its_standard_error(run, folder):
    done = run(folder, "paired.py", "rules:fem", "features:fem")
    assert done.returncode == 0, done.stderr
    # differences 2, 3, 2: mean 7/3, deviation 1/sqrt 3, error 1/3
    assert done.stdout == "92.0 89.7 +2.3 ± 0.33 points over 3 seeds: differ\n"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["rules:fem", "features:naive"], "0 paired seeds"),
        (["rules:fem", "features:fem:device_shift"], "0 paired seeds"),
        (["rules:fem", "features:fem", "seed=0", "device.noise=0"], "0 paired seeds"),
        (["feature", "rules"], "feature"),
        (["rules:fem", "features:fem", "typo=1"], "typo"),
    ],
)
def test_bad_input_ends_with_code_2_and_says_what(run, folder, arguments, named):
    done = run(folder, "paired.py", *arguments)
    assert done.returncode == 2
    assert named in done.stderr
