"""The benchmark measures what it says, in a form that others can read."""

import json
import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from experiments.commands.bench import run_alone
from skin.paths import CONF
from skin.settings import check_settings, import_target


@pytest.mark.slow
def test_generation_reports_rates_and_its_own_memory():
    # 400 MB in this process must not count in the one that is measured.
    ballast = bytearray(400_000_000)
    figures = run_alone("generation", "measure_generation", "naive", 1)
    assert set(figures) == {"gestures_per_second", "frames_per_second", "peak_memory_bytes"}
    # a gesture shows between one frame (static) and twenty (the longest slide)
    assert 1 < figures["frames_per_second"] / figures["gestures_per_second"] < 20
    assert 2e8 < figures["peak_memory_bytes"] < 1.5e9
    assert len(ballast) == 400_000_000


@pytest.mark.slow
def test_a_data_set_is_measured_beside_drawing_alone():
    figures = run_alone("data_sets", "measure_data_set", 64, 1)
    assert set(figures) == {
        "gestures_per_second",
        "ratio_to_generation",
        "bytes_per_gesture",
        "peak_memory_bytes",
    }
    # readings alone are 3000 bytes, which noise keeps from shrinking much; few gestures have a large footer
    assert 2000 < figures["bytes_per_gesture"] < 10000
    assert 2e8 < figures["peak_memory_bytes"] < 1e9
    assert 0 < figures["ratio_to_generation"] < 10


def test_bad_arguments_exit_with_2(run, tmp_path):
    done = run(tmp_path, "bench", "benchmark.repeats=1", store=False)
    assert done.returncode == 2
    assert done.stderr.startswith("benchmark.repeats=1 must be greater")


@pytest.mark.parametrize("path", sorted((CONF / "benchmark").glob("*.yaml")), ids=lambda path: path.stem)
def test_a_benchmark_takes_its_settings(path):
    part = OmegaConf.to_container(OmegaConf.load(path))
    check_settings(import_target(part["_target_"], "benchmark"), part, "benchmark", whole=True)


@pytest.mark.slow
def test_building_starts_cold_each_time(tmp_path, monkeypatch):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))
    figures = run_alone("building", "measure_building", "fem", 1)
    # a warm operator is there in a hundredth of that
    assert figures["build_seconds"] > 0.02
    assert 1e8 < figures["peak_memory_bytes"] < 1.5e9
    assert not list(tmp_path.iterdir())


def test_what_is_not_installed_is_left_out():
    script = (
        "import sys; sys.modules['Pynite'] = None\n"
        "from experiments.benchmarks import harness, mechanics\n"
        "print(mechanics.pynite_seconds_per_frame(3), *harness.versions(['numpy', 'no-such-package']))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == ["None", "numpy"], done.stderr


@pytest.mark.slow
def test_a_verdict_is_timed_by_the_wall_and_by_the_core(run, tmp_path):
    done = run(tmp_path, "bench", "benchmark=live_latency", "benchmark.frames=30", store=False)
    figures = json.loads((tmp_path / "results" / "bench_live_latency.json").read_text())
    assert json.loads(done.stdout) == figures
    assert set(figures) == {"p50_ms", "p99_ms", "core_ms", "core_share", "memory_mb"}
    assert 0 < figures["p50_ms"] <= figures["p99_ms"]


@pytest.mark.slow
def test_the_decoder_is_fuzzed(run, tmp_path):
    few = ["benchmark.count=300", "benchmark.format=binary", "benchmark.sensors=3", "benchmark.seed=1"]
    done = run(tmp_path, "bench", "benchmark=fuzz", *few, store=False)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["format"] == "binary"
    assert figures["good"] == figures["recovered"] > 100
    done = run(tmp_path, "bench", "benchmark=fuzz", "benchmark.format=crc32", store=False)
    assert done.returncode == 2
    assert "benchmark.format=crc32 must be 'crc16'" in done.stderr
