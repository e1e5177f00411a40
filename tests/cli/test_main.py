"""The command line as a user meets it: exit codes, messages, help, and what reaches the run."""

import contextlib
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rtcd_jax.cli import main as cli
from rtcd_jax.cli.options import FLAT
from rtcd_jax.cli.search_verbs import OptimizeOptions
from rtcd_jax.config.load import load, resolved
from rtcd_jax.system.devices import cores
from tests.paths import ROOT

RTCD = str(ROOT / "configs" / "pendulum_rtcd.yaml")

# Runs the command line, then says on the last line of stdout whether anything heavy was imported.
PROBE = """
import sys
from rtcd_jax.cli.main import main
try:
    code = main(sys.argv[1:])
except SystemExit as stop:
    code = stop.code
heavy = {"jax", "mujoco", "scipy", "matplotlib", "orbax", "evosax", "equinox"} & sys.modules.keys()
print(sorted(heavy))
sys.exit(code)
"""


def rtcd(*arguments):
    process = subprocess.run([sys.executable, "-c", PROBE, *arguments], capture_output=True, text=True, cwd=ROOT)
    *output, heavy = process.stdout.splitlines()
    assert heavy == "[]"
    return process.returncode, "\n".join(output), process.stderr


def flat(text):
    """Help or an error without its frame and line breaks."""
    return " ".join(re.sub(r"[╭╮╰╯─│]", " ", text).split())


def yaml_file(folder, **replaced):
    text = Path(RTCD).read_text()
    for old, new in replaced.values():
        assert old in text
        text = text.replace(old, new)
    path = folder / "x.yaml"
    path.write_text(text)
    return str(path)


def keys(tree, path=""):
    branches = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for name, branch in branches:
        key = f"{path}{name}"
        first = branch[0] if isinstance(branch, list) and branch else branch
        nested = isinstance(first, dict) and bool(first)
        yield from keys(branch, f"{key}.") if nested else [key]


def test_help_lists_the_verbs():
    code, output, _ = rtcd("--help")
    assert code == 0
    assert all(f"  {verb} " in output for verb in cli.VERBS)
    assert rtcd() == rtcd("--help") == rtcd("-h")


def test_version_is_the_package_s():
    from importlib.metadata import version

    assert rtcd("--version") == (0, f"rtcd {version('rtcd-jax')}", "")


@pytest.mark.parametrize("arguments", [["optimize", "--help"], ["optimize", RTCD, "--help"]])
def test_help_of_optimize_names_every_key_with_unit_and_default(arguments):
    code, output, _ = rtcd(*arguments)
    assert code == 0
    text = flat(output)
    options = {option.split(" ")[0].rstrip(","): option for option in re.split(r" --(?=\w)", text)}
    for key in keys(resolved(load(Path(RTCD)))):
        if key.endswith(".pinned") or key == "search.refine":  # --search.refine, --search.no-refine
            continue
        assert "(default: " in options[key], key
        assert re.search(r"\[.+\]", options[key]) or "{" in options[key], key
    assert "[kg] (>= -1e+09 and <= 1e+09) (default: 0.7)" in options["design.mass.initial"]
    assert "[1/(s (N m)^2)] (>= -1e+09 and <= 1e+09) (default: 0.001)" in options["weights.r.0.min"]
    assert "hold the initial value" in text


def test_help_shows_the_file_s_own_values(tmp_path):
    path = yaml_file(tmp_path, seed=("seed: 0", "seed: 77"))
    _, output, _ = rtcd("optimize", path, "--help")
    assert "(default: 77)" in flat(output)
    assert "(default: checkpoints/x)" in flat(output)


WRONG = {
    "misspelt verb": (["optimise"], "unknown command 'optimise'; did you mean 'optimize'? Valid: optimize, configs"),
    "no file": (["optimize", "configs/pendulum_rtcdd.yaml"], "no such file; did you mean 'configs/pendulum_rtcd.yaml'"),
    "no arguments": (["optimize"], "Missing from rtcd optimize: CONFIG"),
    "option first": (["optimize", "--run", "x", RTCD], "the configuration comes first, but found '--run'"),
    "misspelt option": (["optimize", RTCD, "--search.popultion", "8"], "Perhaps you meant: --search.population"),
    "wrong type": (["optimize", RTCD, "--search.population", "x"], "Error parsing --search.population"),
    "wrong name": (["optimize", RTCD, "--search.objective", "inlets"], "invalid choice 'inlets'"),
    "out of range": (["optimize", RTCD, "--search.population", "3"], "search.population = 3: must be >= 4"),
    "start outside": (["optimize", RTCD, "--task.start", "7", "0"], "task.start.0 = 7.0: must lie between"),
    "too few": (["optimize", RTCD, "--task.start", "1"], "task.start: must have 2 entries (theta, theta_dot), has 1"),
    "no run": (["verify", "no/such/run"], "no/such/run: no such run folder"),
    "no states": (["verify", "configs", "--states", "0"], "--states = 0: must be >= 1"),
    "negative seed": (["verify", "configs", "--seed", "-1"], "--seed = -1: must be >= 0"),
    "no run to disturb": (["disturb", "no/such/run"], "no/such/run: no such run folder"),
    "nothing to disturb": (["disturb", "configs", "--states", "0"], "--states = 0: must be >= 1"),
    "negative seed of noise": (["disturb", "configs", "--seed", "-1"], "--seed = -1: must be >= 0"),
    "no run to export": (["export", "no/such/run", "--to", "x"], "no/such/run: no such run folder"),
    "negative elite": (["export", "configs", "--to", "x", "--elite", "-1"], "--elite = -1: must be >= 0, or initial"),
    "no such elite's name": (["export", "configs", "--to", "x", "--elite", "best"], "--elite"),
    "nowhere to export to": (["export", "configs"], "--to"),
    "no run to report": (["report"], "which run? rtcd report RUN [RUN …] [--to FILE]"),
    "no such run to report": (["report", "configs", "no/such/run"], "no/such/run: no such run folder"),
    "no such run to animate": (["animate", "no/such/run"], "no/such/run: no such run folder"),
    "negative seed to animate": (["animate", "configs", "--seed", "-1"], "--seed = -1: must be >= 0"),
    "no such run to replay": (["replay", "no/such/run", "x.csv"], "no/such/run: no such run folder"),
    "nothing to replay": (["replay", "configs"], "FILE"),
    "negative elite to replay": (
        ["replay", "configs", "x.csv", "--elite", "-1"],
        "--elite = -1: must be >= 0, or initial",
    ),
    "misspelt verify option": (["verify", "configs", "--sed", "1"], "--seed"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_explained_before_anything_heavy(case):
    arguments, words = WRONG[case]
    code, output, errors = rtcd(*arguments)
    assert code == 2
    assert output == ""
    assert words in flat(errors)
    assert "Traceback" not in errors


def test_all_errors_of_a_file_at_once(tmp_path):
    path = yaml_file(tmp_path, key=("seed: 0", "sed: 0"), type=("knots: 51", "knots: many"), range=("0.99", "1.0"))
    code, _, errors = rtcd("optimize", path)
    assert code == 2
    assert errors.splitlines() == [
        f"rtcd: {path}: 3 errors",
        "  trajectory.knots = 'many': must be a whole number; knots N+1 of the nominal motion [-] (paper, section III)",
        "  funnel.confidence = 1.0: must be > 0 and < 1; 1 - beta, jointly over the knots [-]",
        "  search.sed = 0: unknown key; did you mean 'seed'? Valid: objective, at_least, mode, population, "
        "generations, patience, over_tasks, share, sigma, seed, chunk, refine, nested",
    ]


def test_yaml_syntax(tmp_path):
    code, _, errors = rtcd("optimize", yaml_file(tmp_path, bracket=("[0.0, 0.0]", "[0.0, 0.0")))
    assert code == 2
    assert "no valid YAML: line " in errors


def test_overrides_are_the_configuration_s():
    overrides = {
        "search.population": 512,
        "search.objective": "inlet",
        "weights.q.0.max": 10.5,
        "design.mass.max": 0.7,
        "trajectory.step.max": 0.05,
        "task.state_limits": ["inf", 7],
    }
    words = [word for key, value in overrides.items() for word in (f"--{key}", *map(str, _listed(value)))]
    words = [RTCD, "--run", "elsewhere", *words, "--design.length.pinned"]
    options = OptimizeOptions.read(words, "rtcd optimize")
    assert options.run == Path("elsewhere")
    expected = load(Path(RTCD)).model_dump()
    expected["search"] |= {"population": 512, "objective": "inlet"}
    expected["weights"]["q"][0]["max"] = 10.5
    expected["design"]["mass"]["max"] = 0.7
    expected["design"]["length"]["pinned"] = True
    expected["trajectory"]["step"]["max"] = 0.05
    expected["task"]["state_limits"] = (float("inf"), 7.0)
    assert options.config.model_dump() == expected


def _listed(value):
    return value if isinstance(value, list) else [value]


def test_without_overrides_the_file_is_the_run():
    options = OptimizeOptions.read([RTCD], "rtcd optimize")
    assert (options.config, options.run) == (load(Path(RTCD)), Path("checkpoints/pendulum_rtcd"))


ALL_WRONG = {
    "verify": (
        ["no/such/run", "--states", "0", "--seed", "-1"],
        ["no/such/run: no such run folder", "--states = 0: must be >= 1", "--seed = -1: must be >= 0"],
    ),
    "replay": (
        ["configs", "x.csv", "--elite", "-1", "--start", "nan"],
        ["--elite = -1: must be >= 0, or initial", "--start = nan: must be finite"],
    ),
    "audit": (
        [
            *("x.csv", "--plant", "pendulum", "--parameters", "m=1", "l", "b=x"),
            *("--q", "1", "nan", "--r", "1", "--out", "out", "--states", "0"),
        ],
        [
            "--parameters l: must be NAME=VALUE with a number", "--parameters b=x: must be NAME=VALUE",
            "--q nan: must be finite", "--states = 0: must be >= 1",
        ],
    ),
    "scale": (
        [RTCD, "--populations", "3,64", "--devices", "0", "--repeats", "0"],
        [
            "--populations = 3,64: all must be >= 4", "--devices = 0: all must be >= 1",
            "--repeats = 0: must be >= 1",
        ],
    ),
    "optimize": (
        [RTCD, "--search.population", "3", "--task.start", "1", "--devices", "0", "--process_id", "-1"],
        [
            "--search.population = 3: must be >= 4", "--task.start: must have 2 entries", "--devices = 0: must be >= 1",
            "--process_id = -1: must be >= 0",
        ],
    ),
}  # fmt: skip


@pytest.mark.parametrize("verb", ALL_WRONG)
def test_all_wrong_options_are_told_at_once(verb, capsys):
    arguments, words = ALL_WRONG[verb]
    assert cli.main([verb, *arguments]) == 2
    heading, *lines = capsys.readouterr().err.splitlines()
    assert heading == f"rtcd: {len(words)} errors"
    assert all(line.startswith(f"  {start}") for line, start in zip(lines, words, strict=True)), lines


@pytest.mark.parametrize("verb", sorted(cli.VERBS.keys() - {"check"}))
def test_every_option_has_a_meaning_and_every_number_a_unit(verb):
    module, _, name = cli.VERBS[verb].function.partition(":")
    model = next(iter(inspect.signature(getattr(importlib.import_module(module), name)).parameters.values())).annotation
    for option, field in model.model_fields.items():
        assert field.description or FLAT in field.metadata, option
        if field.annotation in (int, float):
            assert "[" in field.description or "process" in field.description, option


@pytest.mark.parametrize(
    ("verb", "arguments"), [("report", ["."]), ("animate", ["."]), ("replay", [".", "measured.csv"])]
)
def test_what_is_no_run_folder_is_told_in_one_line(verb, arguments, tmp_path, capsys, monkeypatch, as_in_a_process):
    monkeypatch.chdir(tmp_path)
    assert cli.main([verb, *arguments]) == 2
    assert capsys.readouterr().err == "rtcd: . is no run folder: it has no format.json\n"


@pytest.mark.parametrize("verb", cli.VERBS)
def test_help_has_an_example(verb, capsys):
    with contextlib.suppress(SystemExit):
        assert cli.main([verb, "--help"]) == 0
    text = flat(capsys.readouterr().out)
    assert f"Example: rtcd {verb} " in text
    assert "None" not in text  # but what holds where an option is left away


PREPARED = """
from rtcd_jax.system.devices import prepare_jax
prepare_jax()
import jax
print(jax.device_count(), jax.numpy.zeros(1).dtype)
"""


def prepared(environment):
    chosen = {"JAX_PLATFORMS": "cpu", **environment}
    process = subprocess.run([sys.executable, "-c", PREPARED], capture_output=True, text=True, check=True, env=chosen)
    return process.stdout.strip()


def test_double_precision_on_every_core():
    assert prepared({}) == f"{cores()} float64"


@pytest.mark.thorough
@pytest.mark.parametrize(
    "chosen", [{"JAX_NUM_CPU_DEVICES": "3"}, {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}]
)
def test_the_user_s_devices_are_kept(chosen):
    assert prepared(chosen) == "3 float64"


def test_help_imports_nothing_but_the_standard_library():
    """Half a second is promised for `rtcd --help`, and imports are what takes time."""
    code = (
        "import sys; from rtcd_jax.cli.main import main; main(['--help']); print({'pydantic', 'tyro'} & {*sys.modules})"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert process.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--devices", "0"], r"--devices = 0: must be >= 1"),
        (
            ["--coordinator", "a:1"],
            r"2 errors\n  --num_processes: must be given too; .*\n  --process_id: must be given",
        ),
        (["--coordinator", "a:1", "--num_processes", "2", "--process_id", "2"], r"must be < --num_processes = 2"),
    ],
)
def test_devices_and_processes_are_checked_before_anything_starts(options, message, capsys):
    assert cli.main(["optimize", RTCD, *options]) == 2
    assert re.search(message, capsys.readouterr().err)
