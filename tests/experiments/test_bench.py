"""The benchmark measures what it says, in a form that others can read."""

import json
import subprocess
import sys

import pytest

from skin.paths import ROOT

GENERATION = ROOT / "experiments" / "benchmarks" / "generation.py"


def test_generation_reports_rates_and_its_own_memory():
    # 400 MB in this process must not count in the one that is measured.
    ballast = bytearray(400_000_000)
    command = [sys.executable, str(GENERATION), "naive", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    figures = json.loads(done.stdout)
    assert set(figures) == {"gestures_per_second", "frames_per_second", "peak_memory_bytes"}
    # a gesture shows between one frame (static) and twenty (the longest slide)
    assert 1 < figures["frames_per_second"] / figures["gestures_per_second"] < 20
    assert 2e8 < figures["peak_memory_bytes"] < 1.5e9
    assert len(ballast) == 400_000_000


def test_bad_arguments_exit_with_2(run, tmp_path):
    done = run(tmp_path, "bench", "bench.repeats=1", store=False)
    assert done.returncode == 2
    assert "repeats" in done.stderr


def test_the_table_refuses_bad_arguments(run, tmp_path):
    done = run(tmp_path, "table", "table.seeds=0", store=False)
    assert done.returncode == 2
    assert "table.seeds=0 must be greater" in done.stderr


def test_building_starts_cold_each_time(run, tmp_path, monkeypatch):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path))
    done = run(tmp_path, "benchmarks/building.py", "fem", "1", store=False)
    figures = json.loads(done.stdout)
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
    done = run(tmp_path, "benchmarks/live_latency.py", "30", store=False)
    figures = json.loads(done.stdout)
    assert set(figures) == {"p50_ms", "p99_ms", "core_ms", "core_share"}
    assert 0 < figures["p50_ms"] <= figures["p99_ms"]
