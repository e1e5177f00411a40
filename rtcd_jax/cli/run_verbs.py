"""The verbs that read a run or a file beside it: each its options and what it does with them.

The packages that do the work are imported once the options are known to be right.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import tyro
from pydantic import AfterValidator, Field

from rtcd_jax.cli.exits import Exit, heeding_sigterm
from rtcd_jax.cli.options import Cache, Elite, ExistingRun, Options, Positional, Run, shown
from rtcd_jax.config.schema import REFINABLE, REFINEMENT_STEPS
from rtcd_jax.config.settings import refusal
from rtcd_jax.system.console import Console, silent
from rtcd_jax.system.devices import cores
from rtcd_jax.system.errors import Problem, UserError


def _verdict(held: bool) -> Exit:
    return Exit.OK if held else Exit.REFUTED


def _each_task(run: Path, console: Console) -> Iterator[Path]:
    """The folder of every task of a run, said aloud where there are several; of one task the run's own."""
    from rtcd_jax.elite.records import task_folders

    for folder in task_folders(run):
        if folder != run:
            console.message(f"task {folder.name}:")
        yield folder


class VerifyOptions(Options):
    """Simulate held-out states of a run's funnels with independent simulators; exit code 1 if too many fail.

    The same command goes on after a stop.

    Example: rtcd verify checkpoints/pendulum_rtcd --states 100000
    """

    run: Run = Field(description="the run folder")
    states: int = Field(
        default=1000, description="held-out states, over the ellipsoids of all knots, one each at least [-]", ge=1
    )
    seed: int = Field(default=0, description="of the states [-]", ge=0)
    workers: int = Field(default=0, description="processes, 0 for one a core [-]", ge=0)


def verify(options: VerifyOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.verify.run import verify_run

    how = options.states, options.seed, options.workers or cores(), console
    held = [verify_run(folder, *how) for folder in _each_task(options.run, console)]
    return _verdict(all(held))


class ReportOptions(Options):
    """Write a finished run's page, report.html, and its figures; several runs are compared on one page.

    --table prints the paper's Table I of the runs and writes nothing; runs that differ in their seed alone share a row.

    Example: rtcd report checkpoints/pendulum_rtc checkpoints/pendulum_rtcd --to comparison.html
    Example: rtcd report checkpoints/pendulum_rtc checkpoints/pendulum_rtcd --table latex
    """

    runs: Annotated[Positional[tuple[ExistingRun, ...]], shown("RUN [RUN …]")] = Field(description="the run folders")
    to: Annotated[Path | None, shown("FILE", "in or beside the run")] = Field(default=None, description="the page")
    table: Annotated[Literal["latex", "csv", "md"] | None, shown("{latex,csv,md}", "the page")] = Field(
        default=None, description="print a table in this form instead"
    )

    def problems(self) -> Iterator[Problem]:
        if not self.runs:
            yield Problem((), "which run? rtcd report RUN [RUN …] [--to FILE]")


def report(options: ReportOptions, console: Console) -> Exit:
    if options.table:
        from rtcd_jax.analysis.report.publication import table_of
        from rtcd_jax.analysis.report.reading import read_run

        console.message(table_of([read_run(run, silent()) for run in options.runs], options.table))
        return Exit.OK
    from rtcd_jax.analysis.report import report as write_report

    page, *figures = write_report(options.runs, options.to, console)
    console.message(f"{page}, and {len(figures)} figures in {figures[0].parent}")
    return Exit.OK


class ListOptions(Options):
    """List the runs in a folder and below: how far each is, its best volume, guarantee, verification, what it bears.

    Example: rtcd list checkpoints
    """

    folder: Annotated[Positional[Path], shown("DIR")] = Field(
        default=Path("checkpoints"), description="where to look, three folders deep"
    )


def list_(options: ListOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.overview import list_runs

    console.message(list_runs(options.folder, console))
    return Exit.OK


class ShowOptions(Options):
    """Say what a run is, how far, what it found, what of it is proved and verified, and what uncertainty it bears.

    Example: rtcd show checkpoints/pendulum_rtcd
    """

    run: Run = Field(description="the run folder")


def show(options: ShowOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.overview import show_run

    for line in show_run(options.run, console):
        console.message(line)
    return Exit.OK


class DiffOptions(Options):
    """Compare two runs: the keys in which their configurations differ, their best candidates and volumes.

    Example: rtcd diff checkpoints/pendulum_rtc checkpoints/pendulum_rtcd
    """

    first: Annotated[Positional[ExistingRun], shown("RUN1")] = Field(description="a run folder")
    second: Annotated[Positional[ExistingRun], shown("RUN2")] = Field(description="another one")


def diff(options: DiffOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.overview import diff_runs

    for part in diff_runs(options.first, options.second, console):
        console.message(part)
    return Exit.OK


def _within(target: Path, folder: Path, run: Path) -> Path:
    """Where in a target a task's results go: with several in a folder of its own."""
    return target if folder == run else target / folder.name


class AnimateOptions(Options):
    """Show the swing-up by MuJoCo's renderer as MP4 and GIF: initial beside best, undisturbed and disturbed. Of a cycle
    of tasks the best, swing after swing.

    Needs no display: it draws by EGL or OSMesa.

    Example: rtcd animate checkpoints/pendulum_rtcd --to videos
    """

    run: Run = Field(description="the run folder")
    to: Annotated[Path | None, shown("DIR", "animation/ in RUN")] = Field(default=None, description="for the videos")
    seed: int = Field(default=0, description="of the disturbed start, from the first ellipsoid [-]", ge=0)
    swings: int = Field(default=4, description="of a cycle of tasks: so many, one behind the other [-]", ge=1)


def animate(options: AnimateOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.animate.animate import animate_run
    from rtcd_jax.analysis.animate.cycle import animate_cycle
    from rtcd_jax.elite.records import is_cycle

    if is_cycle(options.run):
        animate_cycle(options.run, options.to, options.seed, options.swings, console)
        return Exit.OK
    for folder in _each_task(options.run, console):
        to = options.to and _within(options.to, folder, options.run)
        animate_run(folder, to, options.seed, console)
    return Exit.OK


class ReplayOptions(Options):
    """Was a measured run inside the funnel? V/rho of every sample; exit code 1 if it left.

    FILE is a table of times and states in SI units under a line of column names, which are found by their words
    (position, vel2, cart_pos, pos_meas1, "Angle [deg]" …). Time counts from the start of the swing-up. Errors of angles
    are not wrapped.

    Example: rtcd replay checkpoints/pendulum_rtcd measured.csv --start 2.5 --unwrap
    Example: rtcd replay checkpoints/pendulum_rtcd log.csv --columns time=stamp theta=enc theta_dot=4
    """

    run: Run = Field(description="the run folder")
    file: Annotated[Positional[Path], shown("FILE")] = Field(description="the measured states, a CSV file")
    elite: Elite = Field(default=0, description="whose funnel; 0 is the best [-] (>= 0); or initial")
    columns: Annotated[tuple[str, ...], shown("NAME=COLUMN …")] = Field(
        default=(), description="columns of the time and the states, by name or number from 1"
    )
    start: Annotated[float | None, shown("T", "0")] = Field(
        default=None, description="time of the file at which the motion begins [s]"
    )
    unwrap: bool = Field(default=False, description="take whole turns out of angles that wrap")


def replay(options: ReplayOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.replay.replay import replay_run

    return _verdict(
        replay_run(options.run, options.file, options.elite, console, options.columns, options.start, options.unwrap)
    )


class DisturbOptions(Options):
    """Try the initial candidate and the best elite: off-nominal starts, pushes, wrong models, noise, delay.

    Example: rtcd disturb checkpoints/pendulum_rtcd --states 1000
    """

    run: Run = Field(description="the run folder")
    states: int = Field(default=1000, description="uniform states of every first ellipsoid [-]", ge=1)
    seed: int = Field(default=0, description="of states, noise and perturbations [-]", ge=0)
    cache: Cache = Field(default=None, description="of compiled programs, '' for none")


def disturb(options: DisturbOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.disturb import disturb_run

    for folder in _each_task(options.run, console):
        disturb_run(folder, options.states, options.seed, console)
    return Exit.OK


class ToleranceOptions(Options):
    """Find the largest factor of every uncertainty, and of all at once, under which an elite's policy has a funnel.

    The box is the run's `uncertainty`, or that of a YAML file. Where numbers of the robot are uncertain, the whole box
    is tried a second time with numbers that are constant, each robot about its own motion. Results: a table, and
    tolerance/NNN.json, .csv, .png and .pdf in the run folder; all factors are sampled, within 1 %. With --prove the
    whole box is proved, too, within 5 %, by some ten certificates, of which tolerance/certificates/NNN.json is the
    largest that holds.

    Example: rtcd tolerance checkpoints/pendulum_robust --uncertainty lab.yaml
    Example: rtcd tolerance checkpoints/pendulum_robust --prove
    """

    run: Run = Field(description="the run folder")
    elite: Elite = Field(default=0, description="0 is the best [-] (>= 0); or initial")
    uncertainty: Annotated[Path | None, shown("FILE", "the run's own")] = Field(
        default=None, description="a YAML with an `uncertainty` section, whose half widths are the factor 1"
    )
    prove: bool = Field(default=False, description="also the largest factor of the whole box that is proved")
    cache: Cache = Field(default=None, description="of compiled programs, '' for none")


def tolerance(options: ToleranceOptions, console: Console) -> Exit:
    from rtcd_jax.analysis.tolerance.study import tolerance_run

    for folder in _each_task(options.run, console):
        tolerance_run(folder, options.elite, options.uncertainty, console, options.prove)
    return Exit.OK


class ExportOptions(Options):
    """Write an elite for a lab: controller and funnel monitor in Python and C, tables, MJCF and URDF.

    Example: rtcd export checkpoints/pendulum_rtcd --to lab/pendulum
    """

    run: Run = Field(description="the run folder")
    to: Annotated[Path, shown("DIR")] = Field(description="a new or empty folder, or a former export, to replace it")
    elite: Elite = Field(default=0, description="0 is the best [-] (>= 0); or initial")
    name: Annotated[str | None, shown("NAME", "ROBOT_ELITE")] = Field(
        default=None, description="of the controller's files and C symbols"
    )


def export(options: ExportOptions, console: Console) -> Exit:
    from rtcd_jax.elite.records import is_cycle
    from rtcd_jax.export import export_cycle, export_run

    targets = []
    for folder in _each_task(options.run, console):
        targets.append(_within(options.to, folder, options.run))
        export_run(folder, options.elite, targets[-1], console, options.name)
    if is_cycle(options.run):
        export_cycle(targets, console)
    return Exit.OK


def _refinable(text: str) -> str:
    """A list of what can be refined, split by commas."""
    wrong = [name for name in text.split(",") if name not in REFINABLE]
    if wrong:
        raise refusal(f"must be one or more of {', '.join(REFINABLE)}, split by commas")
    return text


class RefineOptions(Options):
    """Refine gains and ellipsoids' shapes of a run's best elites by gradients, so that the funnels under the run's
    uncertainty grow.

    A refined elite takes its place among the others only where the elites' own estimator finds the run's objective
    larger; what was replaced stays in unrefined/. The same command goes on after a stop.

    Example: rtcd refine checkpoints/pendulum_robust --elites 4
    """

    run: Run = Field(description="the run folder")
    elites: int = Field(default=1, description="how many, the best first [-]", ge=1)
    free: Annotated[str, AfterValidator(_refinable), shown("NAME,NAME")] = Field(
        default="gains,shapes", description="what is refined"
    )
    steps: int = Field(default=REFINEMENT_STEPS, description="of the optimizer [-]", ge=1, le=1_000_000)
    cache: Cache = Field(default=None, description="of compiled programs, '' for none")


def refine(options: RefineOptions, console: Console) -> Exit:
    from rtcd_jax.run.refine import refine_run

    free = tuple(name for name in REFINABLE if name in options.free.split(","))
    refine_run(options.run, options.elites, free, options.steps, console)
    return Exit.OK


class CertifyOptions(Options):
    """Prove the funnels of a run's best elites by sums of squares; `rtcd check` checks what this writes.

    Guarantees: certified, by the solver's floating-point numbers; proved, by exact arithmetic for the true dynamics.
    The same command goes on after a kill. Exit code 1 if a funnel was not shown from t = 0 to the goal or the catch, or
    a cycle of tasks was not closed.

    Example: rtcd certify checkpoints/pendulum_rtcd --elites 8 --optimize_value
    """

    run: Run = Field(description="the run folder")
    elites: int = Field(default=1, description="how many, the best first [-]", ge=1)
    elite: Annotated[int | None, shown("NUMBER", "the best ones")] = Field(
        default=None, description="only this one: a task of a job array, launch/slurm/certify.sbatch [-]", ge=0
    )
    guarantee: Annotated[Literal["certified", "proved"], tyro.conf.arg(aliases=("--rung",))] = Field(
        default="proved", description="to be shown"
    )
    optimize_value: bool = Field(default=False, description="choose the ellipsoids' shapes too")
    uncertainty: Annotated[Path | None, shown("FILE", "what the run bears")] = Field(
        default=None, description="a YAML of what the proof bears, as `uncertainty` of a configuration; none: one model"
    )
    solver: Annotated[str, shown("NAME")] = Field(
        default="CLARABEL", description="of the semidefinite programs, by cvxpy's name: SCS, MOSEK, COPT, ..."
    )
    share: float = Field(
        default=1.0,
        description="of the sampled levels, that are proved at most: smaller ellipsoids have simpler proofs [-]",
        gt=0,
        le=1,
    )
    workers: int = Field(
        default=0, description="processes, one an elite; its programs share the rest; 0: cores [-]", ge=0
    )


def certify(options: CertifyOptions, console: Console) -> Exit:
    from rtcd_jax.certificate.prove.cycle import close_cycle, foresee
    from rtcd_jax.certificate.prove.run import certify_run
    from rtcd_jax.elite.records import elite_name, is_cycle, require_elites

    workers, only = options.workers or cores(), None if options.elite is None else elite_name(options.elite)
    how = options.optimize_value, options.uncertainty, options.solver, options.share, only
    with heeding_sigterm():
        cyclic = is_cycle(options.run)
        names = require_elites(options.run)[: options.elites] if only is None else [only]
        if cyclic:
            foresee(options.run, names, options.share, options.uncertainty, console)
        folders = _each_task(options.run, console)
        goals = [certify_run(each, options.elites, options.guarantee, workers, console, *how) for each in folders]
        if cyclic:
            goals.append(close_cycle(options.run, names, options.guarantee, options.solver, console))
        return _verdict(all(goals))


def _certificate(path: Path) -> Path:
    """The best elite's, of a run folder."""
    if not path.is_dir():
        return path
    from rtcd_jax.elite.records import require_one_task

    try:
        require_one_task(path)
    except UserError as error:
        raise refusal(str(error).removeprefix(f"{path} ")) from None
    return path / "certificates" / "000.json"


class FalsifyOptions(Options):
    """Simulate motions from the boundary and the inside of what a certificate says is proved, at instants all over it.

    Equations and integrator share nothing with the proof. Exit code 1 if a motion leaves the funnel, a limit or the
    goal region, beyond the integrator's own error, which is measured. The same command goes on after a kill.

    Example: rtcd falsify checkpoints/pendulum_rtcd/certificates/000.json --rollouts 100000
    """

    certificate: Annotated[Positional[Path], AfterValidator(_certificate), shown("FILE")] = Field(
        description="a certificate, or a run folder (its 000)"
    )
    rollouts: int = Field(default=1_000_000, description="motions to simulate [-]", ge=1)
    seed: int = Field(default=0, description="of their starts, robots and disturbances [-]", ge=0)
    workers: int = Field(default=0, description="processes, 0 for one a core [-]", ge=0)
    beyond: float = Field(
        default=1.0, description="factor of all that the certificate leaves uncertain [-]", ge=0, le=100
    )


def falsify(options: FalsifyOptions, console: Console) -> Exit:
    from rtcd_jax.certificate.falsify.falsify import falsify_file

    workers = options.workers or cores()
    held = falsify_file(options.certificate, options.rollouts, options.seed, workers, console, options.beyond)
    return _verdict(held)


def _assignment(text: str) -> str:
    try:
        float(text.partition("=")[2])
    except ValueError:
        raise refusal("must be NAME=VALUE with a number") from None
    return text


class AuditOptions(Options):
    """Simulate an external funnel, knot by knot, and project its nominal motion onto the dynamics for a proof.

    FILE is a table: after a row of headings one row a knot, with the time, the states, the input held until the next
    knot, rho, and the upper triangle of S; or the trajectory alone, and --funnel has rho and all of S. The gains are
    R^-1 B'S. Exit code 1 if a state left the funnel.

    Example: rtcd audit funnel.csv --plant pendulum --parameters m=0.7 l=0.4 b=0.1 g=9.81 torque_limit=2.5
    --q 10 1 --r 0.1 --out checkpoints/audit
    """

    file: Annotated[Positional[Path], shown("FILE")] = Field(description="the trajectory and its funnel")
    plant: Annotated[str, shown("NAME|YAML")] = Field(
        description="a packaged robot with one motor, or a configuration whose robot it is"
    )
    parameters: Annotated[tuple[Annotated[str, AfterValidator(_assignment)], ...], shown("NAME=VALUE …")] = Field(
        description="its physical numbers; of a configuration's robot, those that are other than the file's [SI]"
    )
    q: tuple[float, ...] = Field(description="diagonal of the cost's Q [1/(s state's unit^2)]")
    r: float = Field(description="the cost's R [1/(s input's unit^2)]")
    out: Annotated[Path, shown("FOLDER")] = Field(description="where the audit and the elites are stored")
    funnel: Annotated[Path | None, shown("FILE", "in FILE")] = Field(
        default=None, description="rho and S row by row, a knot a column (or a row)"
    )
    state_limits: Annotated[tuple[Annotated[float, Field(allow_inf_nan=True)], ...], shown("LIMIT …", "none")] = Field(
        default=(), description="largest |x_i|, inf for none [state's unit]"
    )
    states: int = Field(default=1000, description="random states of each ellipsoid [-]", ge=1)
    seed: int = Field(default=0, description="of the states [-]", ge=0)


def audit(options: AuditOptions, console: Console) -> Exit:
    from rtcd_jax.certificate.audit.audit import audit_funnel
    from rtcd_jax.certificate.audit.external import Cost, read_external

    pairs = (text.partition("=") for text in options.parameters)
    numbers = {name: float(value) for name, _, value in pairs}
    given = read_external(options.file, options.plant, numbers, options.funnel)
    cost = Cost.of(given, options.q, options.r, options.state_limits)
    return _verdict(audit_funnel(given, cost, options.states, options.seed, options.out, console))
