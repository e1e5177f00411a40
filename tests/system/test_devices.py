"""CPU counts, the cache of programs and the GPUs that a job was given."""

import json
import math
import os
import subprocess
import sys

import jax
import pytest

from rtcd_jax.config.load import EXAMPLE, parse_yaml
from rtcd_jax.elite.records import FORMAT, VERSION
from rtcd_jax.problem import make_problem
from rtcd_jax.system.devices import cores, default_cache, gpus_given, quota
from rtcd_jax.system.errors import UserError
from tests.paths import ROOT

SHOW = (
    "import jax, rtcd_jax; rtcd_jax.prepare_jax({}); "
    "print(jax.config.jax_compilation_cache_dir, jax.config.jax_compilation_cache_max_size > 0)"
)


def python(code, *arguments, **environment):
    told = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    told |= {"PYTHONPATH": str(ROOT)} | environment
    return subprocess.run(command, cwd=ROOT, env=told, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("files", "groups", "allowed"),
    [
        ({"cpu.max": "150000 100000\n"}, "0::/\n", 1.5),
        ({"a/b/cpu.max": "max 100000\n", "a/cpu.max": "200000 100000\n"}, "0::/a/b\n", 2),
        ({"a/cpu.max": "100000 100000\n"}, "0::/other\n", math.inf),
        ({"cpu/job/cpu.cfs_quota_us": "250000\n", "cpu/job/cpu.cfs_period_us": "100000\n"}, "4:cpu:/job/step\n", 2.5),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, "4:cpu:/\n", math.inf),
        ({"cpu,cpuacct/cpu.cfs_quota_us": "50000\n", "cpu,cpuacct/cpu.cfs_period_us": "100000\n"},
         "7:memory:/x\n4:cpu,cpuacct:/gone\n", 0.5),
        ({}, "", math.inf),
        ({"cpu.max": "nonsense"}, "0::/\n", math.inf),
    ],
)  # fmt: skip
def test_the_quota_of_either_version_counts(tmp_path, files, groups, allowed):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert quota(tmp_path, groups) == allowed


def test_cores_are_at_least_one_and_at_most_the_affinity_mask(tmp_path):
    assert 1 <= cores(tmp_path) <= os.cpu_count()
    (tmp_path / "cpu.max").write_text("10000 100000")
    assert cores(tmp_path) == 1


@pytest.mark.parametrize(
    ("environment", "given"),
    [
        ({"SLURM_JOB_ID": "1", "SLURM_JOB_GPUS": "0,1"}, "SLURM_JOB_GPUS=0,1"),
        ({"SLURM_JOB_ID": "1", "SLURM_GPUS_ON_NODE": "2"}, "SLURM_GPUS_ON_NODE=2"),
        ({"SLURM_JOB_ID": "1", "CUDA_VISIBLE_DEVICES": "0"}, "CUDA_VISIBLE_DEVICES=0"),
        ({"SLURM_JOB_ID": "1", "SLURM_GPUS_ON_NODE": "0", "CUDA_VISIBLE_DEVICES": "NoDevFiles"}, None),
        ({"SLURM_JOB_ID": "1", "CUDA_VISIBLE_DEVICES": ""}, None),
        ({"CUDA_VISIBLE_DEVICES": "0"}, None),
    ],
)
def test_gpus_are_those_that_slurm_gave(environment, given):
    assert gpus_given(environment) == given


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("environment", "code", "text"),
    [
        ({"SLURM_JOB_ID": "1", "SLURM_JOB_GPUS": "0"}, 2, "rtcd: Slurm gave this job GPUs (SLURM_JOB_GPUS=0), but JAX"),
        ({"JAX_PLATFORMS": "cuda"}, 2, "rtcd: JAX_PLATFORMS = 'cuda': JAX finds no such device here"),
    ],
)
def test_a_cpu_is_no_substitute_for_the_gpus_of_a_job(tmp_path, environment, code, text):
    main = "import sys; from rtcd_jax.cli.main import main; sys.exit(main(sys.argv[1:]))"
    done = python(main, "optimize", "configs/smoke.yaml", "--run", tmp_path / "run", **environment)
    assert (done.returncode, done.stderr.count("\n")) == (code, 1), done.stderr
    assert done.stderr.startswith(text)
    assert not (tmp_path / "run").exists()
    (tmp_path / "format.json").write_text(json.dumps({"format": FORMAT, "version": VERSION}))
    (tmp_path / "elites").mkdir()
    (tmp_path / "elites" / "000.json").touch()
    done = python(main, "disturb", tmp_path, **environment)
    assert (done.returncode, done.stderr.count("\n")) == (code, 1), done.stderr
    assert done.stderr.startswith(text)


@pytest.mark.thorough
def test_programs_are_kept_in_the_users_cache_unless_told_otherwise(tmp_path):
    home = {"XDG_CACHE_HOME": str(tmp_path / "xdg")}
    shown = python(SHOW.format(""), **home)
    assert shown.stdout.split() == [str(tmp_path / "xdg" / "rtcd_jax" / "xla"), "True"], shown.stderr
    assert python(SHOW.format("cache=''"), **home).stdout.split()[0] == "None"
    mine = python(SHOW.format(""), **home, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "mine"))
    assert mine.stdout.split()[0] == str(tmp_path / "mine")
    (tmp_path / "file").touch()
    shown = python(SHOW.format(""), XDG_CACHE_HOME=str(tmp_path / "file"))
    assert shown.stdout.split()[0] == "None"
    assert shown.stderr == (
        f"compiled programs are not kept: cannot write {tmp_path}/file/rtcd_jax/xla: Not a directory\n"
    )


def test_the_default_cache_is_in_the_home_folder(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert default_cache() == "/home/somebody/.cache/rtcd_jax/xla"


def test_a_problem_in_single_precision_is_refused():
    config = parse_yaml(EXAMPLE)
    with jax.enable_x64(False), pytest.raises(UserError, match=r"float32: call rtcd_jax.prepare_jax\(\) first"):
        make_problem(config)
