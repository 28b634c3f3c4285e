"""Workers that die, a scheduler elsewhere: every point comes, and what is missing is told in a line."""

import os
import platform
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import dask.config
import pytest
from tests.sweep.small_sweep import Sweeping, rows_in, swept, written

from nlcwfs.studies import sweep_run
from nlcwfs.studies.point_run import PointResult
from nlcwfs.studies.study_table import StudyTable
from nlcwfs.studies.sweep_cluster import local_cluster
from nlcwfs.studies.sweep_points import read_sweep

THREE = "[grid]\nseed = [0, 1, 2]\n"


@contextmanager
def started(module, *words):
    """A process of dask."""
    command = [sys.executable, "-m", f"distributed.cli.{module}", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def scheduler(tmp_path):
    """The address of a scheduler of its own process."""
    told = tmp_path / "scheduler.json"
    words = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--scheduler-file", told)
    with started("dask_scheduler", *words) as process:
        while not told.exists() or not told.stat().st_size:
            assert process.poll() is None
            time.sleep(0.05)
        yield dask.config.yaml.safe_load(told.read_text())["address"], process


def worker(address):
    return started("dask_worker", address, "--nthreads", 1, "--no-nanny", "--no-dashboard")


def test_a_worker_that_is_killed_in_the_midst_costs_no_point(tmp_path, scheduler):
    address, _ = scheduler
    folder = written(tmp_path / "s", THREE)
    with worker(address), worker(address) as victim:
        sweeping = Sweeping(folder, "--scheduler", address)
        sweeping.read_until("[1/3]")
        victim.send_signal(signal.SIGKILL)
        assert sweeping.end() == 0, sweeping.said
    rows = rows_in(folder)
    assert list(rows) == [f"all,seed={seed}" for seed in range(3)]
    assert not any(row["error"] for row in rows.values())


def test_without_workers_it_says_so_waits_and_gives_up(tmp_path, scheduler):
    address, _ = scheduler
    result = swept(written(tmp_path / "s", THREE), "--scheduler", address, "--wait", 0.5)
    assert result.exit_code == 2
    assert f"No worker is at {address} yet; start some: dask worker {address}" in result.stderr
    assert "must have a worker, got none within 0.5 s (--wait)" in result.stderr


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense", "tcp://no.such.host.invalid:8786"])
def test_a_scheduler_that_cannot_be_reached_is_told_in_a_line(tmp_path, monkeypatch, address):
    monkeypatch.setattr("nlcwfs.studies.sweep_cluster.CONNECT_S", 1)
    result = swept(written(tmp_path / "s", THREE), "--scheduler", address)
    assert result.exit_code == 2
    assert f"--scheduler: must be the address of a running scheduler, got {address}: " in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


# ------------------------------------------------------------------- with points that take no time


def pretend(point):
    """Point 1 takes its worker down every time, point 2 fails in an unforeseen way."""
    seed = point.config.seed
    if seed == 1:
        os._exit(1)
    if seed == 2:
        raise ZeroDivisionError("a\nb")
    row = {"point": point.name, "case": point.case, "outcome": "closed", "rms_nm": 5.0}
    return PointResult(row | {"error": "", "commit": "abc", "digest": point.digest}, {})


def settings_of_jax():
    import jax

    cache = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    return *cache, os.environ["XLA_FLAGS"], os.environ["OMP_NUM_THREADS"]


def test_a_worker_has_one_thread_and_keeps_compiled_code(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    with local_cluster(1) as client:
        ((folder, least_s, flags, threads),) = client.run(settings_of_jax).values()
    assert folder == str(tmp_path / "nlcwfs" / "compiled" / platform.node())
    assert least_s == 0
    assert flags == "--xla_cpu_enable_fast_math=false --xla_cpu_multi_thread_eigen=false"
    assert threads == "1"


def test_a_point_that_kills_its_workers_fails_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_run, "run_on_worker", pretend)
    sweep, points = read_sweep(written(tmp_path, THREE))
    table, seen = StudyTable(tmp_path / "results.ecsv", key="point"), []
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}), local_cluster(1) as client:
        sweep_run.run_sweep(client, sweep, points, table, seen.append)
    assert len(seen) == 3
    good, killer, unforeseen = (rows_in(tmp_path)[f"all,seed={seed}"] for seed in range(3))
    assert (good["outcome"], good["rms_nm"], good["error"]) == ("closed", 5.0, "")
    assert (killer["outcome"], unforeseen["outcome"]) == ("failed", "failed")
    assert killer["error"].startswith("2 workers died over it")
    assert unforeseen["error"].startswith("ZeroDivisionError: a b")
    assert sweep_run.missing_points(points, table) == list(points[1:])


def test_a_scheduler_that_goes_away_ends_the_sweep_in_a_line(tmp_path, scheduler):
    address, process = scheduler
    folder = written(tmp_path / "s", f"[grid]\nseed = {list(range(60))}\n")  # not over before it goes, however late
    with worker(address):
        sweeping = Sweeping(folder, "--scheduler", address)
        sweeping.read_until("[1/60]")
        process.kill()
        assert sweeping.end() == 2, sweeping.said
    assert "the scheduler must stay until the end, got no answer from it any more" in sweeping.said
    assert "Traceback" not in sweeping.said
    assert 1 <= len(rows_in(folder)) < 60
