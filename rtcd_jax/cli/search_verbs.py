"""The verbs that evaluate candidates, optimize, sweep and scale: each its options and what it does with them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, PlainValidator

from rtcd_jax.cli.config_options import config_branch
from rtcd_jax.cli.exits import Exit, say
from rtcd_jax.cli.options import FLAT, OPTIMIZE_USAGE, Cache, ExistingRun, Options, Positional, shown
from rtcd_jax.config.load import EXAMPLE, Config, load, parse, parse_yaml
from rtcd_jax.config.packaged import config_path, listing, packaged
from rtcd_jax.config.schema import SMALLEST_POPULATION
from rtcd_jax.config.settings import Settings, invalid, refusal
from rtcd_jax.system.console import Console, silent, table
from rtcd_jax.system.devices import prepare_jax
from rtcd_jax.system.errors import ConfigError, Problem, UserError, closest
from rtcd_jax.system.files import make_folder, replace

if TYPE_CHECKING:
    from rtcd_jax.system.cluster import Cluster

RUNS = Path("checkpoints")
LOGS = {"tensorboard": "tensorboardX", "wandb": "wandb"}
"""The packages that write them."""
_UNDER_SRUN = "as srun or mpirun say"


def _named(given: Path) -> Path:
    try:
        return config_path(given)
    except ConfigError as error:
        raise refusal(error.problems[0].text) from None


_ConfigPath = Annotated[Positional[Path], AfterValidator(_named), shown("CONFIG")]
_EXPERIMENT = "the experiment, a YAML file or the name of a packaged one"


class Machines(Settings):
    """The devices of this process, and the other processes of its run."""

    devices: Annotated[int | None, shown("INT", "all")] = Field(
        default=None, description="devices to use of those each process sees [-]", ge=1
    )
    cpu_devices: Annotated[int | None, shown("INT", "its cores")] = Field(
        default=None, description="parts the CPU is split into [-]", ge=1
    )
    cache: Cache = Field(default=None, description="of compiled programs, '' for none")
    coordinator: Annotated[str | None, shown("HOST:PORT", _UNDER_SRUN)] = Field(
        default=None, description="where process 0 listens"
    )
    num_processes: Annotated[int | None, shown("INT", _UNDER_SRUN)] = Field(
        default=None, description="processes of this run [-]", ge=1
    )
    process_id: Annotated[int | None, shown("INT", _UNDER_SRUN)] = Field(
        default=None, description="this one's number, from 0 [-]", ge=0
    )

    def problems(self) -> Iterator[Problem]:
        together = ("coordinator", "num_processes", "process_id")
        missing = [name for name in together if getattr(self, name) is None]
        if 0 < len(missing) < len(together):
            for name in missing:
                yield Problem((name,), f"must be given too; a process needs all of --{', --'.join(together)}")
        if self.num_processes is not None and self.process_id is not None and self.process_id >= self.num_processes:
            yield Problem(("process_id",), f"must be < --num_processes = {self.num_processes}", self.process_id)


def on_cluster(
    machines: Machines, folder: Path, console: Console, work: Callable[["Console", "Cluster"], None]
) -> Exit:
    """Joins the other processes of `machines`, if any, and does `work(console, cluster)`; only the first one speaks."""
    prepare_jax(machines.cpu_devices, machines.cache)
    from rtcd_jax.system.cluster import Cluster, Lost, Preempted, initialize, shutdown
    from rtcd_jax.system.compilation import announced

    initialize(machines.coordinator, machines.num_processes, machines.process_id)  # before anything touches a device
    cluster = Cluster.of(machines.devices)
    cluster.handle_sigterm()
    speaker = console if cluster.first else silent()
    try:
        cluster.barrier()
        with announced(speaker):
            work(speaker, cluster)
    except Preempted:
        speaker.message(f"asked to stop (SIGTERM): saved in {folder}; the same command goes on")
        shutdown()
        return Exit.PREEMPTED
    except Lost as error:
        say(f"rtcd: {error}; start all of them again by the same command, to go on")
        return Exit.LOST_PROCESS
    return Exit.OK


def _configuration(data: Any) -> Config:
    try:
        return parse(data)
    except ConfigError as error:
        raise invalid(error.problems) from None


def _installed(kind: str | None) -> str | None:
    package = LOGS.get(kind or "")
    if package and find_spec(package) is None:
        raise refusal(f"needs the package {package}: pip install 'rtcd-jax[{kind}]'")
    return kind


_Log = Annotated[
    Literal["tensorboard", "wandb"] | None, AfterValidator(_installed), shown("{tensorboard,wandb}", "nowhere")
]


class OptimizeOptions(Options):
    """Search for the design and the weights with the largest funnel; the same command resumes a stopped run.

    CONFIG comes first. Every key of the YAML is an option; without one, the defaults are those of the paper's pendulum.

    Example: rtcd optimize pendulum_rtcd --run checkpoints/mine --search.population 512
    Example: rtcd optimize configs/pendulum_rtcd.yaml
    Example: rtcd optimize pendulum_robust --from checkpoints/pendulum_rtcd
    """

    file: _ConfigPath = Field(description=_EXPERIMENT)
    config: Annotated[Config, PlainValidator(_configuration), FLAT]
    former: Annotated[ExistingRun | None, shown("RUN", "the file's initial values", name="from")] = Field(
        default=None, description="finished run of this robot, with whose best candidate the search begins"
    )
    run: Annotated[Path, shown("FOLDER")] = Field(description="run folder, resumed if it is there")
    log: _Log = Field(
        default=None, description="show the generations there too, from FOLDER/tensorboard or FOLDER/wandb"
    )
    dry: bool = Field(default=False, description="only say what is understood of the robot and its task")
    machines: Annotated[Machines, FLAT] = Machines()

    @classmethod
    def defaults(cls, words: Sequence[str]) -> Mapping[str, Any]:
        """The file's own values, and a run folder of its name."""
        if words and not words[0].startswith("-"):
            file = config_path(Path(words[0]))
            return {"config": config_branch(load(file)), "run": RUNS / file.stem}
        if words and not {"-h", "--help"} & set(words):
            raise UserError(f"the configuration comes first, but found {words[0]!r}: {OPTIMIZE_USAGE}")
        return {"config": config_branch(parse_yaml(EXAMPLE)), "run": RUNS / "NAME"}


def optimize(options: OptimizeOptions, console: Console) -> Exit:
    """Searches, and makes the run's page."""
    config = options.config
    if options.former is not None:
        from rtcd_jax.elite.warm_start import begun_from

        config = begun_from(config, options.former)
    if options.dry:
        prepare_jax(cache=options.machines.cache)
        from rtcd_jax.problem import make_problem
        from rtcd_jax.run.dry import understood

        for line in understood(make_problem(config)):
            console.message(line)
        return Exit.OK

    def search(console: Console, cluster: "Cluster") -> None:
        from rtcd_jax.run.optimize import optimize as run_optimize

        worked = run_optimize(config, options.run, console, cluster, options.log)
        finish = partial(_finish_page, options.run, worked, console)
        cluster.on_first(partial(cluster.interruptible, finish))

    return on_cluster(options.machines, options.run, console, search)


def _finish_page(run: Path, changed: bool, console: Console) -> None:
    """Makes a finished run's page and figures, unless they are there and still true.

    The run is whole without them: what goes wrong here is a message, and ends nothing.
    """
    if not changed and (run / "report.html").is_file():
        return
    from rtcd_jax.analysis.report import report

    try:
        page, *figures = report([run], console=console)
    except Exception as error:
        console.message(f"the run is finished, but its report failed: {error!r}; `rtcd report {run}` makes it")
    else:
        console.message(f"{page}, and {len(figures)} figures in {figures[0].parent}")


class NewOptions(Options):
    """Write a commented configuration for an MJCF's robot: states, units, limits, numbers that could be designs.

    Example: rtcd new acrobot.xml
    """

    mjcf: Annotated[Positional[Path], shown("XML")] = Field(description="the robot, a tree of hinges and slides")
    to: Annotated[Path | None, shown("YAML", "beside the XML")] = Field(default=None, description="file to write")


def new(options: NewOptions, console: Console) -> Exit:
    """Writes the configuration, never over one that is there."""
    target = options.to or options.mjcf.with_suffix(".yaml")
    if target.exists():
        raise UserError(f"{target} is there: choose another file by --to")
    if target.parent.resolve() != options.mjcf.parent.resolve():
        raise UserError(f"--to = {target}: must lie beside {options.mjcf}, which it names")
    from rtcd_jax.plants.draft import draft

    text = draft(options.mjcf)
    make_folder(target.parent)
    replace(target, text.encode())
    console.message(f"{target}; `rtcd optimize {target} --dry` says what is understood of it")
    return Exit.OK


class SweepOptions(Options):
    """Make every run that the `sweep` section of CONFIG asks for, one after another, each in a run folder of its own.

    The same command goes on where an earlier one stopped. --case K makes one of them, as job arrays do; --list only
    shows them. At the end a table of all cases is printed and stored as FOLDER/table.csv.

    Example: rtcd sweep configs/sweep.yaml --list
    """

    file: _ConfigPath = Field(description="a YAML with a sweep section, or the name of a packaged one")
    folder: Annotated[Path | None, shown("FOLDER", "checkpoints/NAME")] = Field(
        default=None, description="of the run folders"
    )
    case: Annotated[int | None, shown("INT", "all of them")] = Field(
        default=None, description="number of the only one to run [-]", ge=0
    )
    list: bool = Field(default=False, description="show the cases and what is known of them, run nothing")
    machines: Annotated[Machines, FLAT] = Machines()


def sweep(options: SweepOptions, console: Console) -> Exit:
    """Makes the runs one after another; one that ends early leaves the others their turn."""
    from rtcd_jax.run.sweep import read_cases, show, store

    folder = options.folder or RUNS / options.file.stem
    cases = read_cases(options.file, folder)
    if options.case is not None and options.case >= len(cases):
        raise UserError(f"--case = {options.case}: must be one of 0 … {len(cases) - 1}")
    if options.list:
        console.message(show(cases))
        return Exit.OK

    def search(console: Console, cluster: "Cluster") -> None:
        from rtcd_jax.run.optimize import optimize as run_optimize

        failed = []
        for case in cases if options.case is None else [cases[options.case]]:
            console.message(f"case {case.number} of 0 … {len(cases) - 1}: {case.folder}")
            try:
                worked = run_optimize(case.config, case.folder, console, cluster)
                finish = partial(_finish_page, case.folder, worked, console)
                cluster.on_first(partial(cluster.interruptible, finish))
            except UserError as error:  # the others may do better
                console.message(f"case {case.number} ended early: {error}")
                failed.append(case.folder.name)
        cluster.on_first(lambda: console.message(f"{show(cases)}\n{store(cases, folder)}"))
        if failed:
            raise UserError(f"{len(failed)} of the cases ended early, see above: {', '.join(failed)}")

    return on_cluster(options.machines, folder, console, search)


def _counts(least: int) -> Any:
    """Checks a list of whole numbers, none below `least`."""

    def check(text: str) -> str:
        try:
            numbers = counts(text)
        except ValueError:
            raise refusal("must be whole numbers, split by commas") from None
        if min(numbers) < least:
            raise refusal(f"all must be >= {least}")
        return text

    return AfterValidator(check)


def counts(text: str) -> tuple[int, ...]:
    """The whole numbers of a list that is split by commas."""
    return tuple(map(int, text.split(",")))


class ScaleOptions(Options):
    """Measure whole generations against the population and the devices; writes a table and figures.

    Every point runs in a process of its own, on a CPU with a core for each device. What is measured already is not
    measured again.

    Example: rtcd scale configs/pendulum_rtcd.yaml --populations 64,256,1024 --devices 1,2
    """

    file: _ConfigPath = Field(description=_EXPERIMENT)
    populations: Annotated[str, _counts(SMALLEST_POPULATION), shown("P,P,…")] = Field(
        default="64,256,1024", description="candidates in a generation [-]"
    )
    devices: Annotated[str, _counts(1), shown("D,D,…")] = Field(
        default="1,2", description="devices to share them out over [-]"
    )
    repeats: int = Field(default=5, description="timed generations of each point [-]", ge=1)
    folder: Annotated[Path | None, shown("FOLDER", "checkpoints/scale_NAME")] = Field(
        default=None, description="of points, table and figures"
    )


def scale(options: ScaleOptions, console: Console) -> Exit:
    """Measures the points of the grid that are not measured yet."""
    config = load(options.file)
    from rtcd_jax.analysis.scale.study import study

    grid = counts(options.populations), counts(options.devices)
    folder = options.folder or RUNS / f"scale_{options.file.stem}"
    study(options.file, config, *grid, options.repeats, folder, console)
    return Exit.OK


def _one_of_the_packaged(name: str | None) -> str | None:
    if name is not None and name not in packaged():
        raise refusal(f"no packaged configuration; {closest(name, tuple(packaged()))}")
    return name


class ConfigsOptions(Options):
    """List the packaged configurations, or print one: a file to begin an experiment of your own with.

    `rtcd optimize NAME` runs one as it is.

    Example: rtcd configs pendulum_rtcd > mine.yaml
    """

    name: Annotated[Positional[str | None], AfterValidator(_one_of_the_packaged), shown("NAME", "list all")] = Field(
        default=None, description="the one to print"
    )


def configs(options: ConfigsOptions, console: Console) -> Exit:
    if options.name:
        console.message(packaged()[options.name].read_text(encoding="utf-8").rstrip())
    else:
        console.message(table(("configuration", "what it is"), listing(), left={"configuration", "what it is"}))
    return Exit.OK
