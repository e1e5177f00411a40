"""Options of the commands that read a finished run: verify, report, animate, replay, disturb, export."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rtcd_jax.cli.checks import optional, require_at_least, require_elite, require_run
from rtcd_jax.cli.search_options import OPTIMIZE_USAGE
from rtcd_jax.system.errors import UserError


@dataclass(frozen=True)
class VerifyOptions:
    """Simulate fresh random states of a run's funnels with independent integrators; exit code 1 if too many fail.

    The same command goes on after a stop.

    Example: rtcd verify checkpoints/pendulum_rtcd --states 100000
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
    to: Annotated[Path | None, optional("FILE", "the page", "in or beside the run")] = None


@dataclass(frozen=True)
class AnimateOptions:
    """Show the swing-up by MuJoCo's renderer as MP4 and GIF: initial beside best, undisturbed and disturbed.

    Needs no display: it draws by EGL or OSMesa.

    Example: rtcd animate checkpoints/pendulum_rtcd --to videos
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    to: Annotated[Path | None, optional("DIR", "for the videos", "animation/ in RUN")] = None
    seed: Annotated[int, tyro.conf.arg(help="of the disturbed start, from the first ellipsoid [-] (>= 0)")] = 0


@dataclass(frozen=True)
class ReplayOptions:
    """Was a measured run inside the funnel? V/rho of every sample; exit code 1 if it left.

    FILE is a table of times and states in SI units under a line of column names, which are found by their words
    (position, vel2, cart_pos, pos_meas1, "Angle [deg]" …). Time counts from the start of the swing-up. Errors of angles
    are not wrapped.

    Example: rtcd replay checkpoints/pendulum_rtcd measured.csv --start 2.5 --unwrap
    Example: rtcd replay checkpoints/pendulum_rtcd log.csv --columns time=stamp theta=enc theta_dot=4
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="the measured states, a CSV file")]
    elite: Annotated[
        int | Literal["initial"], tyro.conf.arg(metavar="K", help="whose funnel; 0 is the best [-] (>= 0); or initial")
    ] = 0
    columns: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="NAME=COLUMN …", help="columns of the time and the states, by name or number from 1"),
    ] = ()
    start: Annotated[float | None, optional("T", "time of the file at which the motion begins [s]", "0")] = None
    unwrap: Annotated[bool, tyro.conf.arg(help="take whole turns out of angles that wrap")] = False


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
    name: Annotated[
        str | None,
        optional("NAME", "of the controller's files and C symbols", "ROBOT_ELITE"),
    ] = None


def read_verify(arguments: Sequence[str]) -> VerifyOptions:
    """The checked options of `rtcd verify`; `UserError` if one is out of range."""
    options = tyro.cli(VerifyOptions, args=arguments, prog="rtcd verify", use_underscores=True)
    require_at_least(options, states=1, seed=0, workers=0)
    require_run(options.run, OPTIMIZE_USAGE)
    return options


def read_report(arguments: Sequence[str]) -> ReportOptions:
    """The checked options of `rtcd report`; `UserError` if a run is missing."""
    options = tyro.cli(ReportOptions, args=arguments, prog="rtcd report", use_underscores=True)
    if not options.runs:
        raise UserError("which run? rtcd report RUN [RUN …] [--to FILE]")
    for run in options.runs:
        require_run(run, OPTIMIZE_USAGE)
    return options


def read_animate(arguments: Sequence[str]) -> AnimateOptions:
    """The checked options of `rtcd animate`; `UserError` if one is out of range."""
    options = tyro.cli(AnimateOptions, args=arguments, prog="rtcd animate", use_underscores=True)
    require_at_least(options, seed=0)
    require_run(options.run, OPTIMIZE_USAGE)
    return options


def read_replay(arguments: Sequence[str]) -> ReplayOptions:
    """The checked options of `rtcd replay`; `UserError` if one is out of range."""
    options = tyro.cli(ReplayOptions, args=arguments, prog="rtcd replay", use_underscores=True)
    require_elite(options.elite)
    if options.start is not None and not math.isfinite(options.start):
        raise UserError(f"--start = {options.start}: must be a finite number of seconds")
    require_run(options.run, OPTIMIZE_USAGE)
    return options


def read_disturb(arguments: Sequence[str]) -> DisturbOptions:
    """The checked options of `rtcd disturb`; `UserError` if one is out of range."""
    options = tyro.cli(DisturbOptions, args=arguments, prog="rtcd disturb", use_underscores=True)
    require_at_least(options, states=1, seed=0)
    require_run(options.run, OPTIMIZE_USAGE)
    return options


def read_export(arguments: Sequence[str]) -> ExportOptions:
    """The checked options of `rtcd export`; `UserError` if one is out of range."""
    options = tyro.cli(ExportOptions, args=arguments, prog="rtcd export", use_underscores=True)
    require_elite(options.elite)
    require_run(options.run, OPTIMIZE_USAGE)
    return options
