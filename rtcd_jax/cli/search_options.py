"""Options of the commands that evaluate candidates: optimize, sweep, scale."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro
from tyro.constructors import ConstructorRegistry

from rtcd_jax.cli.checks import optional, require_at_least
from rtcd_jax.cli.config_options import Branch, config_branch, plain
from rtcd_jax.cli.machines import Machines
from rtcd_jax.config.load import EXAMPLE, Config, load, parse, parse_yaml
from rtcd_jax.config.schema import SMALLEST_POPULATION
from rtcd_jax.run.sweep import Case, read_cases
from rtcd_jax.system.errors import UserError

OPTIMIZE_USAGE = "rtcd optimize CONFIG [--run FOLDER] [--KEY VALUE …]"


@dataclass(frozen=True)
class OptimizeOptions:
    """Search for the design and the weights with the largest funnel; the same command resumes a stopped run.

    CONFIG comes first. Every key of the YAML is an option; without one, the defaults are those of the paper's pendulum.

    Example: rtcd optimize configs/pendulum_rtcd.yaml --run checkpoints/mine --search.population 512
    """

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG", help="the experiment, a YAML file")]
    settings: Annotated[Branch, tyro.conf.arg(name="")]
    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="run folder, resumed if it is there")]
    machines: Annotated[Machines, tyro.conf.arg(name="")] = field(default_factory=Machines)


@dataclass(frozen=True)
class SweepOptions:
    """Make every run that the `sweep` section of CONFIG asks for, one after another, each in a run folder of its own.

    The same command goes on where an earlier one stopped. --case K makes one of them, as job arrays do; --list only
    shows them. At the end a table of all cases is printed and stored as FOLDER/table.csv.

    Example: rtcd sweep configs/sweep.yaml --list
    """

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG", help="a YAML with a sweep section")]
    folder: Annotated[Path | None, optional("FOLDER", "of the run folders", "checkpoints/NAME")] = None
    case: Annotated[int | None, optional("INT", "number of the only one to run [-] (>= 0)", "all of them")] = None
    list: Annotated[bool, tyro.conf.arg(help="show the cases and what is known of them, run nothing")] = False
    machines: Annotated[Machines, tyro.conf.arg(name="")] = field(default_factory=Machines)


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
    folder: Annotated[Path | None, optional("FOLDER", "of points, table and figures", "checkpoints/scale_NAME")] = None

    def counts(self, name: str) -> tuple[int, ...]:
        """The numbers of a list; `UserError` for one that is no number."""
        try:
            return tuple(int(word) for word in getattr(self, name).split(","))
        except ValueError:
            raise UserError(f"--{name} = {getattr(self, name)}: must be whole numbers, split by commas") from None


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
    options = _parse(arguments, OptimizeOptions(config=tyro.MISSING, settings=config_branch(defaults), run=folder))
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
    require_at_least(options, repeats=1)
    for name, least in (("populations", SMALLEST_POPULATION), ("devices", 1)):
        if min(options.counts(name)) < least:
            raise UserError(f"--{name} = {getattr(options, name)}: all must be >= {least}")
    return load(options.config), replace(options, folder=options.folder or runs / f"scale_{options.config.stem}")


def _parse(arguments: Sequence[str], defaults: OptimizeOptions) -> OptimizeOptions:
    registry = ConstructorRegistry()
    registry.struct_rule(plain)
    return tyro.cli(
        OptimizeOptions,
        prog="rtcd optimize",
        args=arguments,
        default=defaults,
        registry=registry,
        use_underscores=True,
    )
