"""The containers' steps in a fresh virtual environment, and the batch scripts with an image.

No image is built: that needs a daemon. `srun` and `apptainer` are stand-ins that do what follows their options.
"""

import os
import re
import subprocess
import sys

import pytest

from tests.paths import CONFIGS, ROOT

CONTAINER = ROOT / "launch" / "container"
DOCKERFILE, DEFINITION = (CONTAINER / name for name in ("Dockerfile", "rtcd.def"))


def script(path, text):
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(0o755)


def run_sh(folder, *words, **environment):
    """run.sh with the stand-ins; its exit code and what the program in the image was called with."""
    script(folder / "srun", 'exec "${@:2}"')
    script(folder / "apptainer", f'printf "%s\\n" "$@" > {folder}/called; exit 3')
    names = {
        name: value for name, value in os.environ.items() if not name.startswith(("RTCD", "SLURM", "JAX_PLATFORMS"))
    }
    names |= {"PATH": f"{folder}:{os.environ['PATH']}", **environment}
    done = subprocess.run([ROOT / "launch" / "slurm" / "run.sh", *words], env=names, capture_output=True, text=True)
    called = folder / "called"
    return done.returncode, called.read_text().splitlines() if called.exists() else None


def test_run_sh_takes_an_image_and_gives_its_exit_code(tmp_path):
    image = str(tmp_path / "rtcd.sif")
    words = ("optimize", "configs/smoke.yaml", "--run", "two words")
    assert run_sh(tmp_path, *words, RTCD_CONTAINER=image) == (3, ["exec", image, "rtcd", *words])
    told = run_sh(tmp_path, *words, RTCD_CONTAINER=image, JAX_PLATFORMS="cuda", RTCD_APPTAINER="--bind /scratch")
    assert told == (3, ["exec", "--nv", "--bind", "/scratch", image, "rtcd", *words])


def test_without_an_image_run_sh_runs_rtcd_itself(tmp_path):
    script(tmp_path / "rtcd", f'printf "%s\\n" "$@" > {tmp_path}/called; exit 4')
    assert run_sh(tmp_path, "list") == (4, ["list"])


def test_both_containers_copy_the_same_files_and_these_are_there():
    copied = re.findall(r"^COPY (.*) (/\S+)$", DOCKERFILE.read_text(), flags=re.MULTILINE)
    docker = {name for names, _ in copied for name in names.split()}
    files = DEFINITION.read_text().partition("%files")[2].partition("%post")[0]
    apptainer = {line.split()[0] for line in files.splitlines() if line.strip()}
    assert docker == apptainer
    assert all((ROOT / name).exists() for name in docker)
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert all(any(name.startswith(line[1:]) for line in ignored if line.startswith("!")) for name in docker)
    packages = [
        re.search(r"--no-install-recommends ([^\n\\]*)", path.read_text())[1].split()
        for path in (DOCKERFILE, DEFINITION)
    ]
    assert packages[0] == packages[1]


@pytest.mark.slow
def test_the_steps_of_the_containers_make_an_rtcd_that_runs(tmp_path):
    """Downloads all of rtcd's packages."""
    names = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    names["PATH"] = f"{os.path.dirname(sys.executable)}:{names['PATH']}"
    subprocess.run(["sh", CONTAINER / "install.sh", tmp_path / "venv"], env=names, check=True)
    done = subprocess.run(
        [tmp_path / "venv" / "bin" / "rtcd", "configs"], cwd=tmp_path, env=names, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert all(path.stem in done.stdout for path in CONFIGS.glob("*.yaml"))
