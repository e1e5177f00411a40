"""How commands end: codes, one line, interrupts at any moment, streams that are closed, broken or narrow."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

from rtcd_jax.cli import main as cli
from rtcd_jax.cli.exits import STOPPED, Exit
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.processes import processes
from tests.paths import ROOT
from tests.stopping import stop

SMOKE = str(ROOT / "configs" / "smoke.yaml")
RTCD = [sys.executable, "-m", "rtcd_jax"]


def start(*command, **environment):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | environment, start_new_session=True, **pipes)


def call(*arguments, **environment):
    process = start(*RTCD, *arguments, **environment)
    output, errors = process.communicate(timeout=300)
    return process.returncode, output, errors


# ---- codes


@pytest.mark.parametrize("path", ["docs/commands.md", "launch/README.md"])
def test_the_documents_and_the_help_list_every_exit_code(path, capsys):
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    (table,) = re.findall(r"^\| exit code \| meaning \|\n(?:\|.+\|\n)+", (ROOT / path).read_text(), re.MULTILINE)
    rows = dict(re.findall(r"^\| (\d+) \| (.+) \|$", table, re.MULTILINE))
    assert rows == {str(code.value): code.meaning for code in Exit}
    assert all(re.search(rf"^ +{code.value}  {re.escape(code.meaning)}$", shown, re.MULTILINE) for code in Exit)


def broken(_):
    raise RuntimeError("no such\n\x1b[31mlane")


def test_an_unexpected_error_is_one_line_and_no_refuted_promise(monkeypatch, capsys):
    monkeypatch.setitem(cli.VERBS, "report", broken)
    assert cli.main(["report", "x"]) == Exit.BUG == 70
    assert capsys.readouterr().err == (
        "rtcd: unexpected error: RuntimeError: no such\\n\\x1b[31mlane; run again with --debug for the traceback\n"
    )


@pytest.mark.parametrize(
    "arguments", [["--debug", "report", "x"], ["report", "--debug", "x"], ["report", "x", "--debug"]]
)
def test_debug_shows_the_traceback(arguments, monkeypatch, capsys):
    monkeypatch.setitem(cli.VERBS, "report", broken)
    assert cli.main(arguments) == Exit.BUG
    errors = capsys.readouterr().err
    assert "Traceback (most recent call last)" in errors
    assert "in broken" in errors
    assert "--debug" not in errors


def fail(kind):
    raise kind("in a worker")


@pytest.mark.parametrize(("kind", "code"), [(ZeroDivisionError, Exit.BUG), (UserError, Exit.WRONG_INPUT)])
def test_what_a_worker_raises_is_what_the_command_ends_with(kind, code, monkeypatch, capsys):
    def verb(_):
        with processes(1) as pool:
            pool.submit(fail, kind).result()

    monkeypatch.setitem(cli.VERBS, "verify", verb)
    assert cli.main(["verify", "--debug"]) == code
    errors = capsys.readouterr().err
    assert "in fail" in errors  # the worker's own traceback
    assert errors.splitlines()[-1].endswith("in a worker")


def test_a_device_that_is_not_there_is_wrong_input(tmp_path):
    code, _, errors = call("optimize", SMOKE, "--run", str(tmp_path / "run"), JAX_PLATFORMS="cuda")
    assert code == Exit.WRONG_INPUT
    assert errors.splitlines()[-1].startswith("rtcd: JAX_PLATFORMS = 'cuda': JAX finds no such device here; ")
    assert "Traceback" not in errors


@pytest.mark.parametrize("module", ["rtcd_jax", "rtcd_jax.cli", "rtcd_jax.cli.main"])
def test_the_package_runs_as_a_module(module):
    process = subprocess.run([sys.executable, "-m", module, "optimise"], cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == Exit.WRONG_INPUT
    assert process.stderr.startswith("rtcd: unknown command 'optimise'; did you mean 'optimize'?")


# ---- interrupts


def ends_interrupted(process, send=os.kill):
    """It ends in time, with the code and one line."""
    _, errors = stop(process, signal.SIGINT, send)
    assert (process.returncode, errors) == (Exit.INTERRUPTED, f"{STOPPED}\n")


# Where the main thread cannot end by itself: inside a library, and where the exception gets lost.
STUCK = {
    "in a library": "import hashlib; hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)",
    "in a callback of the collector": """
import gc, time
def collecting(*_):
    for _ in range(600):
        time.sleep(0.1)
gc.callbacks.append(collecting)
while True:
    gc.collect()
""",
    "while threads are at work": """
import hashlib
from concurrent.futures import ThreadPoolExecutor
ThreadPoolExecutor(1).submit(hashlib.pbkdf2_hmac, "sha256", b"", b"", 2**31 - 1).result()
""",
    "taken for another error": """
import time
try:
    time.sleep(600)
except BaseException:
    raise ImportError("numpy.core.multiarray failed to import")
""",
    "taken for the end": """
import time
try:
    time.sleep(600)
except BaseException:
    raise SystemExit(0)
""",
}


@pytest.mark.parametrize("case", STUCK)
def test_an_interrupt_ends_a_command_wherever_it_is(case):
    program = f"""
import sys
from rtcd_jax.cli import main as cli
def verb(_):
    print("begun", flush=True)
    exec({STUCK[case]!r}, {{}})
cli.VERBS["report"] = verb
sys.argv[1:] = ["report"]
sys.exit(cli.main())
"""
    process = start(sys.executable, "-c", program)
    assert process.stdout.readline() == "begun\n"
    time.sleep(0.2)
    ends_interrupted(process)


@pytest.mark.thorough
@pytest.mark.parametrize("delay", [0.0, 4.0])
def test_an_interrupt_ends_a_search_that_compiles(delay, tmp_path):
    process = start(*RTCD, "optimize", SMOKE, "--run", str(tmp_path / "run"), JAX_COMPILATION_CACHE_DIR=str(tmp_path))
    while "compiling" not in process.stdout.readline():
        pass
    time.sleep(delay)
    ends_interrupted(process)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for processes in /proc")
@pytest.mark.parametrize("send", [os.kill, os.killpg])
def test_an_interrupt_ends_the_workers_too_without_a_word(send):
    """Sent to the command alone, and as a terminal does, to all of its group."""
    program = """
import multiprocessing, sys, time
from rtcd_jax.cli import main as cli
from rtcd_jax.system.processes import processes
def verb(_):
    with processes(2) as pool:
        busy = [pool.submit(time.sleep, 600) for _ in range(2)]
        while not all(each.running() for each in busy):
            time.sleep(0.01)
        print(*(child.pid for child in multiprocessing.active_children()), flush=True)
        busy[0].result()
cli.VERBS["verify"] = verb
sys.argv[1:] = ["verify"]
sys.exit(cli.main())
"""
    process = start(sys.executable, "-c", program)
    workers = process.stdout.readline().split()
    assert len(workers) == 2
    time.sleep(1.0)
    ends_interrupted(process, send)
    patience = time.monotonic() + 30
    while any(alive(worker) for worker in workers) and time.monotonic() < patience:
        time.sleep(0.05)
    assert not any(alive(worker) for worker in workers)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


# ---- streams


@pytest.fixture
def shell(tmp_path):
    """Runs a command line of bash, in which `rtcd` is this project's; its exit codes, one for each part of a pipe."""

    def run(command, **environment):
        line = (
            f'rtcd() {{ "{sys.executable}" -m rtcd_jax "$@"; }}; {command}; echo ${{PIPESTATUS[@]}} >{tmp_path}/codes'
        )
        told = subprocess.run(["bash", "-c", line], cwd=ROOT, env=os.environ | environment, capture_output=True)
        return [int(code) for code in (tmp_path / "codes").read_text().split()], *(
            stream.decode(errors="replace") for stream in (told.stdout, told.stderr)
        )

    return run


@pytest.mark.parametrize("arguments", ["--help", "optimize --help", "--version"])
def test_a_reader_that_has_gone_ends_a_command_quietly(arguments, shell):
    codes, _, errors = shell(f"(sleep 0.5; rtcd {arguments}; exit $?) | true")
    assert (codes, errors) == ([Exit.CUT_OFF, 0], "")
    codes, _, errors = shell(f"(sleep 0.5; rtcd {arguments} 2>&1; exit $?) | true")
    assert (codes, errors) == ([Exit.CUT_OFF, 0], "")


def test_a_reader_that_has_enough_gets_what_it_wants(shell):
    codes, output, errors = shell("rtcd --help | head -1")
    assert codes in ([0, 0], [Exit.CUT_OFF, 0])
    assert output.startswith("usage: rtcd")
    assert errors == ""


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
@pytest.mark.parametrize(("arguments", "code"), [("--help", 0), ("optimise", 2), ("verify --help", 0)])
def test_closed_streams_change_no_exit_code(closed, arguments, code, shell):
    codes, _, errors = shell(f"rtcd {arguments} {closed}")
    assert codes == [code]
    assert "Traceback" not in errors
    assert "rror" not in errors


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
@pytest.mark.parametrize(("arguments", "code"), [("--help", 0), ("optimize --help", 0), ("Gefäß", 2)])
def test_narrow_encodings_take_what_they_can(encoding, arguments, code, shell):
    codes, output, errors = shell(f"rtcd {arguments}", PYTHONIOENCODING=encoding, PYTHONUTF8="0")
    assert codes == [code]
    assert "Traceback" not in errors + output
    assert ("unknown command 'Gef" in errors) == (code == 2)
    assert "usage: rtcd" in output + errors or code == 2


@pytest.mark.parametrize("name", [b"\xff\xfe.yaml", "θ̇.yaml".encode()])
@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_paths_that_no_encoding_knows_are_named(name, encoding):
    process = subprocess.run(
        [*RTCD, "optimize", name], cwd=ROOT, capture_output=True, env=os.environ | {"PYTHONIOENCODING": encoding}
    )
    assert process.returncode == Exit.WRONG_INPUT
    assert b".yaml: no such file" in process.stderr
    assert process.stderr.count(b"\n") == 1
