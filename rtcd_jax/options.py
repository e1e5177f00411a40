"""Command line → checked options, by tyro. Overrides are merged into the YAML's mapping and validated as one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import tyro
from pydantic.fields import FieldInfo
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from rtcd_jax.config import EXAMPLE, SMALLEST_POPULATION, UNIT, Config, Variable, load, parse, parse_yaml
from rtcd_jax.errors import UserError
from rtcd_jax.settings import Settings, bounds
from rtcd_jax.sweep import Case, read_cases

_COORDINATOR = "where process 0 listens; srun and mpirun need none"
POLICY_UNITS = {"authority": "-", "discount": "1/s"}
OPTIMIZE_USAGE = "rtcd optimize CONFIG [--run FOLDER] [--KEY VALUE …]"


@dataclass(frozen=True)
class Branch:
    """A node of the tree of options: tyro parses its fields, `collect` gathers their values in a plain container."""

    fields: tuple[StructFieldSpec, ...]
    collect: Callable[..., Any] = dict


@dataclass(frozen=True)
class Machines:
    """The devices of this process, and the other processes of its run."""

    devices: Annotated[int | None, tyro.conf.arg(help="devices to use of those each process sees [-] (all)")] = None
    cpu_devices: Annotated[int | None, tyro.conf.arg(help="parts the CPU is split into [-] (its cores)")] = None
    coordinator: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT", help=_COORDINATOR)] = None
    num_processes: Annotated[int | None, tyro.conf.arg(help="processes of this run [-] (known under srun)")] = None
    process_id: Annotated[int | None, tyro.conf.arg(help="this one's number [-] (0 …, known under srun)")] = None

    def require_sense(self) -> None:
        """Raises `UserError` unless all of coordinator, number and id are given, or none, and all are in range."""
        for name, least in (("devices", 1), ("cpu_devices", 1), ("num_processes", 1), ("process_id", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise UserError(f"--{name} = {value}: must be >= {least}")
        together = ("coordinator", "num_processes", "process_id")
        missing = [f"--{name}" for name in together if getattr(self, name) is None]
        if 0 < len(missing) < len(together):
            raise UserError(
                f"{', '.join(missing)}: must be given too; a process needs all of --{', --'.join(together)}"
            )
        if self.num_processes is not None and self.process_id is not None and self.process_id >= self.num_processes:
            raise UserError(f"--process_id = {self.process_id}: must be < --num_processes = {self.num_processes}")


@dataclass(frozen=True)
class OptimizeOptions:
    """Search for the design and the weights with the largest funnel; the same command resumes a stopped run.

    CONFIG comes first. Every key of the YAML is an option; without one, the defaults are those of the paper's pendulum.
    """

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG", help="the experiment, a YAML file")]
    settings: Annotated[Branch, tyro.conf.arg(name="")]
    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="run folder, resumed if it is there")]
    machines: Annotated[Machines, tyro.conf.arg(name="")] = Machines()


@dataclass(frozen=True)
class SweepOptions:
    """Make every run that the `sweep` section of CONFIG asks for, one after another, each in a run folder of its own.

    The same command goes on where an earlier one stopped. --case K makes one of them, as job arrays do; --list only
    shows them. At the end a table of all cases is printed and stored as FOLDER/table.csv.

    Example: rtcd sweep configs/sweep.yaml --list
    """

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG", help="a YAML with a sweep section")]
    folder: Annotated[Path | None, tyro.conf.arg(help="of the run folders (checkpoints/NAME)")] = None
    case: Annotated[int | None, tyro.conf.arg(help="number of the only one to run [-] (0 …)")] = None
    list: Annotated[bool, tyro.conf.arg(help="show the cases and what is known of them, run nothing")] = False
    machines: Annotated[Machines, tyro.conf.arg(name="")] = Machines()


@dataclass(frozen=True)
class ScaleOptions:
    """Measure whole generations against the population and the devices; writes a table and figures.

    Every point runs in a process of its own, on a CPU with a core for each device; what is measured already is kept.

    Example: rtcd scale configs/pendulum_rtcd.yaml --populations 64,256,1024 --devices 1,2
    """

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG", help="the experiment, a YAML file")]
    populations: Annotated[str, tyro.conf.arg(metavar="P,P,…", help="candidates in a generation [-]")] = "64,256,1024"
    devices: Annotated[str, tyro.conf.arg(metavar="D,D,…", help="devices to share them out over [-]")] = "1,2"
    repeats: Annotated[int, tyro.conf.arg(help="timed generations of each point [-] (>= 1)")] = 5
    folder: Annotated[Path | None, tyro.conf.arg(help="of points, table and figures (checkpoints/scale_NAME)")] = None

    def counts(self, name: str) -> tuple[int, ...]:
        """The numbers of a list; `UserError` for one that is no number."""
        try:
            return tuple(int(word) for word in getattr(self, name).split(","))
        except ValueError:
            raise UserError(f"--{name} = {getattr(self, name)}: must be whole numbers, split by commas") from None


@dataclass(frozen=True)
class VerifyOptions:
    """Simulate fresh random states of a run's funnels with independent integrators; exit code 1 if too many fail.

    The same command goes on after a stop. Example: rtcd verify checkpoints/pendulum_rtcd --states 100000
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    states: Annotated[int, tyro.conf.arg(help="fresh states, over the ellipsoids of all knots [-] (>= knots)")] = 1000
    seed: Annotated[int, tyro.conf.arg(help="of the states [-] (>= 0)")] = 0
    workers: Annotated[int, tyro.conf.arg(help="processes, 0 for one a core [-] (>= 0)")] = 0


@dataclass(frozen=True)
class ReportOptions:
    """Write a finished run's page, report.html, and its figures; several runs are compared on one page.

    Example: rtcd report checkpoints/pendulum_rtc checkpoints/pendulum_rtcd --to comparison.html
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN [RUN …]", help="the run folders")
    ]
    to: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help="the page; by default in or beside the run")] = None


@dataclass(frozen=True)
class AnimateOptions:
    """Show the swing-up by MuJoCo's renderer as MP4 and GIF: initial beside best, undisturbed and disturbed.

    Needs no display: it draws by EGL or OSMesa. Example: rtcd animate checkpoints/pendulum_rtcd --to videos
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    to: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help="for the videos; by default animation/ in RUN")] = None
    seed: Annotated[int, tyro.conf.arg(help="of the disturbed start, from the first ellipsoid [-] (>= 0)")] = 0


@dataclass(frozen=True)
class ReplayOptions:
    """Was a measured run inside the funnel? V/rho of every sample; exit code 1 if it left.

    FILE has the columns time,pos,vel,torque or time,pos1,pos2,vel1,vel2,tau1,tau2 in SI units, the time from the start
    of the swing-up. Errors of angles are not wrapped: unwrap the encoder first.
    Example: rtcd replay checkpoints/pendulum_rtcd measured.csv --elite 0
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="the measured states, a CSV file")]
    elite: Annotated[
        int | Literal["initial"], tyro.conf.arg(metavar="K", help="whose funnel; 0 is the best [-] (>= 0); or initial")
    ] = 0


@dataclass(frozen=True)
class CertifyOptions:
    """Prove the funnels of a run's best elites by sums of squares; `rtcd check` checks what this writes.

    Rungs: certified, by the solver's floating-point numbers; proved, by exact arithmetic for the true dynamics. The
    same command goes on after a kill. Exit code 1 if a funnel was not shown from t = 0 to the goal.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    elites: Annotated[int, tyro.conf.arg(help="how many, the best first [-] (>= 1)")] = 1
    rung: Annotated[Literal["certified", "proved"], tyro.conf.arg(help="how much is to be shown")] = "proved"
    optimize_value: Annotated[bool, tyro.conf.arg(help="free the ellipsoids' shape where that enlarges it")] = False
    workers: Annotated[int, tyro.conf.arg(help="processes, one elite each [-] (>= 1)")] = 2


@dataclass(frozen=True)
class FalsifyOptions:
    """Simulate motions from the boundary and the inside of what a certificate says is proved, at instants all over it.

    Equations and integrator share nothing with the proof. Exit code 1 if a motion leaves the funnel, a limit or the
    goal region, beyond the integrator's own error, which is measured.

    example: rtcd falsify checkpoints/pendulum_rtcd/certificates/000.json --rollouts 100000
    """

    certificate: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="a certificate, or a run folder (its 000)")
    ]
    rollouts: Annotated[int, tyro.conf.arg(help="motions to simulate [-] (>= 1)")] = 1_000_000
    seed: Annotated[int, tyro.conf.arg(help="of their starts [-] (>= 0)")] = 0
    workers: Annotated[int, tyro.conf.arg(help="processes [-] (>= 1)")] = 2


@dataclass(frozen=True)
class AuditOptions:
    """Simulate a funnel from outside, knot by knot, and mend its nominal motion so that one can be proved about it.

    FILE is a table: after a row of headings one row a knot, with the time, the states, the input held until the next
    knot, rho, and the upper triangle of S. The gains are R^-1 B'S. Exit code 1 if a state left the funnel.

    example: rtcd audit funnel.csv --plant pendulum --parameters m=0.7 l=0.4 b=0.1 g=9.81 torque_limit=2.5
    --q 10 1 --r 0.1 --out checkpoints/audit
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="the trajectory and its funnel")]
    plant: Annotated[str, tyro.conf.arg(help="pendulum or cartpole")]
    parameters: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE …", help="its physical numbers [SI]")]
    q: Annotated[tuple[float, ...], tyro.conf.arg(help="diagonal of the cost's Q [1/(s state's unit^2)]")]
    r: Annotated[float, tyro.conf.arg(help="the cost's R [1/(s input's unit^2)]")]
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="where the audit and the elites are stored")]
    state_limits: Annotated[tuple[float, ...], tyro.conf.arg(help="largest |x_i|, inf for none [state's unit]")] = ()
    states: Annotated[int, tyro.conf.arg(help="fresh states of each ellipsoid [-] (>= 1)")] = 1000
    seed: Annotated[int, tyro.conf.arg(help="of the states [-] (>= 0)")] = 0

    @property
    def numbers(self) -> dict[str, float]:
        """The parameters by name; `UserError` for one that is not NAME=VALUE."""
        found = {}
        for text in self.parameters:
            name, _, value = text.partition("=")
            try:
                found[name] = float(value)
            except ValueError:
                raise UserError(f"--parameters {text}: must be NAME=VALUE with a number") from None
        return found


@dataclass(frozen=True)
class DisturbOptions:
    """Try the initial candidate and the best elite: off-nominal starts, pushes, wrong models, noise, delay.

    Example: rtcd disturb checkpoints/pendulum_rtcd --states 1000
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    states: Annotated[int, tyro.conf.arg(help="uniform states of every first ellipsoid [-] (>= 1)")] = 1000
    seed: Annotated[int, tyro.conf.arg(help="of states, noise and perturbations [-] (>= 0)")] = 0


@dataclass(frozen=True)
class ExportOptions:
    """Write an elite for a lab: controller and funnel monitor in Python and C, tables, MJCF and URDF.

    Example: rtcd export checkpoints/pendulum_rtcd --to lab/pendulum
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    to: Annotated[Path, tyro.conf.arg(metavar="DIR", help="a new or empty folder, or a former export, to replace it")]
    elite: Annotated[
        int | Literal["initial"], tyro.conf.arg(metavar="K", help="0 is the best [-] (>= 0); or initial")
    ] = 0


def read_optimize(arguments: Sequence[str], runs: Path) -> tuple[Config, OptimizeOptions]:
    """The configuration with its overrides, and the options beside it.

    Raises `UserError` for a wrong YAML or value; tyro itself exits with code 2 for an unknown option.
    """
    if arguments and not arguments[0].startswith("-"):
        source = Path(arguments[0])
        defaults, folder = load(source), runs / source.stem
    elif not arguments or {"-h", "--help"} & set(arguments):
        defaults, folder = parse_yaml(EXAMPLE), runs / "NAME"
    else:
        raise UserError(f"the configuration comes first, but found {arguments[0]!r}: {OPTIMIZE_USAGE}")
    options = _parse(arguments, OptimizeOptions(config=tyro.MISSING, settings=_config_branch(defaults), run=folder))
    options.machines.require_sense()
    return parse(options.settings, f"{options.config} with the options given"), options


def read_sweep(arguments: Sequence[str], runs: Path) -> tuple[list[Case], SweepOptions]:
    """All cases of the sweep, and the options. Raises `UserError` for a wrong YAML or a case that is not there."""
    options = tyro.cli(SweepOptions, args=arguments, prog="rtcd sweep", use_underscores=True)
    options.machines.require_sense()
    options = replace(options, folder=options.folder or runs / options.config.stem)
    cases = read_cases(options.config, options.folder)
    if options.case is not None and not 0 <= options.case < len(cases):
        raise UserError(f"--case = {options.case}: must be one of 0 … {len(cases) - 1}")
    return cases, options


def read_scale(arguments: Sequence[str], runs: Path) -> tuple[Config, ScaleOptions]:
    """The configuration and the options; `UserError` for a wrong YAML or number."""
    options = tyro.cli(ScaleOptions, args=arguments, prog="rtcd scale", use_underscores=True)
    if options.repeats < 1:
        raise UserError(f"--repeats = {options.repeats}: must be >= 1")
    for name, least in (("populations", SMALLEST_POPULATION), ("devices", 1)):
        if min(options.counts(name)) < least:
            raise UserError(f"--{name} = {getattr(options, name)}: all must be >= {least}")
    return load(options.config), replace(options, folder=options.folder or runs / f"scale_{options.config.stem}")


def read_verify(arguments: Sequence[str]) -> VerifyOptions:
    """The checked options of `rtcd verify`; `UserError` if one is out of range."""
    options = tyro.cli(VerifyOptions, args=arguments, prog="rtcd verify", use_underscores=True)
    for name, least in (("states", 1), ("seed", 0), ("workers", 0)):
        if getattr(options, name) < least:
            raise UserError(f"--{name} = {getattr(options, name)}: must be >= {least}")
    _require_run(options.run)
    return options


def read_report(arguments: Sequence[str]) -> ReportOptions:
    """The checked options of `rtcd report`; `UserError` if a run is missing."""
    options = tyro.cli(ReportOptions, args=arguments, prog="rtcd report", use_underscores=True)
    if not options.runs:
        raise UserError("which run? rtcd report RUN [RUN …] [--to FILE]")
    for run in options.runs:
        _require_run(run)
    return options


def read_animate(arguments: Sequence[str]) -> AnimateOptions:
    """The checked options of `rtcd animate`; `UserError` if one is out of range."""
    options = tyro.cli(AnimateOptions, args=arguments, prog="rtcd animate", use_underscores=True)
    if options.seed < 0:
        raise UserError(f"--seed = {options.seed}: must be >= 0")
    _require_run(options.run)
    return options


def read_replay(arguments: Sequence[str]) -> ReplayOptions:
    """The checked options of `rtcd replay`; `UserError` if one is out of range."""
    options = tyro.cli(ReplayOptions, args=arguments, prog="rtcd replay", use_underscores=True)
    if isinstance(options.elite, int) and options.elite < 0:
        raise UserError(f"--elite = {options.elite}: must be >= 0, or initial")
    _require_run(options.run)
    return options


def read_certify(arguments: Sequence[str]) -> CertifyOptions:
    """The checked options of `rtcd certify`; `UserError` if one is out of range."""
    options = tyro.cli(CertifyOptions, args=arguments, prog="rtcd certify", use_underscores=True)
    for name in ("elites", "workers"):
        if getattr(options, name) < 1:
            raise UserError(f"--{name} = {getattr(options, name)}: must be >= 1")
    _require_run(options.run)
    return options


def read_disturb(arguments: Sequence[str]) -> DisturbOptions:
    """The checked options of `rtcd disturb`; `UserError` if one is out of range."""
    options = tyro.cli(DisturbOptions, args=arguments, prog="rtcd disturb", use_underscores=True)
    if options.states < 1:
        raise UserError(f"--states = {options.states}: must be >= 1")
    if options.seed < 0:
        raise UserError(f"--seed = {options.seed}: must be >= 0")
    _require_run(options.run)
    return options


def read_export(arguments: Sequence[str]) -> ExportOptions:
    """The checked options of `rtcd export`; `UserError` if one is out of range."""
    options = tyro.cli(ExportOptions, args=arguments, prog="rtcd export", use_underscores=True)
    if isinstance(options.elite, int) and options.elite < 0:
        raise UserError(f"--elite = {options.elite}: must be >= 0, or initial")
    _require_run(options.run)
    return options


def _require_run(folder: Path) -> None:
    if not folder.is_dir():
        raise UserError(f"{folder}: no such run folder; `{OPTIMIZE_USAGE}` makes one")


def read_audit(arguments: Sequence[str]) -> AuditOptions:
    """The checked options of `rtcd audit`; `UserError` if one is out of range."""
    options = tyro.cli(AuditOptions, args=arguments, prog="rtcd audit", use_underscores=True)
    for name, least in (("states", 1), ("seed", 0)):
        if getattr(options, name) < least:
            raise UserError(f"--{name} = {getattr(options, name)}: must be >= {least}")
    return options


def read_falsify(arguments: Sequence[str]) -> FalsifyOptions:
    """The checked options of `rtcd falsify`; `UserError` if one is out of range."""
    options = tyro.cli(FalsifyOptions, args=arguments, prog="rtcd falsify", use_underscores=True)
    for name, least in (("rollouts", 1), ("seed", 0), ("workers", 1)):
        if getattr(options, name) < least:
            raise UserError(f"--{name} = {getattr(options, name)}: must be >= {least}")
    if options.certificate.is_dir():
        return replace(options, certificate=options.certificate / "certificates" / "000.json")
    return options


def _parse(arguments: Sequence[str], defaults: OptimizeOptions) -> OptimizeOptions:
    registry = ConstructorRegistry()
    registry.struct_rule(_plain)
    return tyro.cli(
        OptimizeOptions,
        prog="rtcd optimize",
        args=arguments,
        default=defaults,
        registry=registry,
        use_underscores=True,
    )


def _plain(info: StructTypeInfo) -> StructConstructorSpec | None:
    if isinstance(info.default, Branch):
        return StructConstructorSpec(info.default.collect, info.default.fields)
    return None


def _config_branch(config: Config) -> Branch:
    plant = config.plant
    design = {name: _section(variable, plant.design[name]) for name, variable in config.design.items()}
    weights = {"q": _list(config.weights.q, plant.states), "r": _list(config.weights.r, plant.inputs)}
    task = _section(config.task, ", ".join(plant.states.values()))
    searched = config.policy.variables()
    policy = _section(
        config.policy, branches={name: _section(option, POLICY_UNITS[name]) for name, option in searched.items()}
    )
    branches = {"task": task, "design": _group(design), "weights": _group(weights), "policy": policy}
    return _section(config, branches=branches)


def _list(weights: Sequence[Variable], units: Mapping[str, str]) -> Branch:
    pairs = zip(weights, units.values(), strict=True)
    branches = {str(i): _section(weight, f"1/(s ({unit})^2)") for i, (weight, unit) in enumerate(pairs)}
    return Branch(_group(branches).fields, lambda **values: tuple(values.values()))


def _group(branches: Mapping[str, Branch]) -> Branch:
    return Branch(tuple(StructFieldSpec(name, Branch, branch) for name, branch in branches.items()))


def _section(settings: Settings, unit: str = "", branches: Mapping[str, Branch] | None = None) -> Branch:
    """One option for each field, a branch for each section in it; `unit` replaces the placeholder in their help."""
    ready = branches or {}
    fields = []
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if name in ready or isinstance(value, Settings):
            fields.append(StructFieldSpec(name, Branch, ready.get(name) or _section(value, unit), field.description))
        else:
            kind = float if isinstance(value, float) else cast(type, field.annotation)
            fields.append(StructFieldSpec(name, kind, value, _help(field, unit)))
    return Branch(tuple(fields))


def _help(field: FieldInfo, unit: str) -> str:
    text = str(field.description).replace(UNIT, unit)
    limits = bounds(field)
    return f"{text} ({limits})" if limits else text
