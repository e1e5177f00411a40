"""What is installed from a wheel works without the sources."""

import os
import subprocess
import sys
import zipfile

import pytest

from tests.paths import CONFIGS, ROOT


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder of a wheel's files."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


def test_a_wheel_has_every_file_of_the_package(installed):
    tracked = subprocess.run(["git", "ls-files", "rtcd_jax"], cwd=ROOT, capture_output=True, text=True, check=True)
    missing = [name for name in tracked.stdout.split() if not (installed / name).is_file()]
    assert not missing
    assert (installed / "rtcd_jax" / "py.typed").is_file()


def test_its_configurations_are_found_by_name_anywhere(installed, tmp_path):
    def rtcd(*arguments):
        environment = os.environ | {"PYTHONPATH": str(installed)}
        command = [sys.executable, "-m", "rtcd_jax", *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)

    listed = rtcd("configs")
    assert listed.returncode == 0, listed.stderr
    names = [line.split()[0] for line in listed.stdout.splitlines()[3:]]
    assert names == sorted(path.stem for path in CONFIGS.glob("*.yaml"))
    printed = rtcd("configs", "pendulum_rtc")
    assert printed.stdout == (CONFIGS / "pendulum_rtc.yaml").read_text()
    shown = rtcd("optimize", "pendulum_rtc", "--help")
    assert "checkpoints/pendulum_rtc" in shown.stdout
    cases = rtcd("sweep", "sweep", "--list")
    assert cases.returncode == 0, cases.stderr
    wrong = rtcd("scale", "pendulum_rct")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert wrong.stderr.startswith(
        "rtcd: pendulum_rct: no such file or packaged configuration; did you mean 'pendulum_rtc'? Valid: "
    )
