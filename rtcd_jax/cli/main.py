"""The console script `rtcd`: one thin function for each verb.

Nothing heavy is imported before the input is known to be right.
"""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rtcd_jax.cli.exits import Exit, as_process, explain, say
from rtcd_jax.system.devices import cores, prepare_jax
from rtcd_jax.system.errors import UserError, closest

DEBUG = "--debug"
RUNS = Path("checkpoints")


def optimize(arguments: Sequence[str]) -> int:
    """search for the design and the weights with the largest funnel, or resume a search"""
    from rtcd_jax.cli.search_options import read_optimize

    config, options = read_optimize(arguments, RUNS)

    def run(console, cluster) -> None:
        from rtcd_jax.run.optimize import optimize as run_optimize

        worked = run_optimize(config, options.run, console, cluster)
        cluster.on_first(lambda: _finish_page(options.run, worked, console))

    return _on_cluster(options.machines, options.run, run)


def sweep(arguments: Sequence[str]) -> int:
    """make all the runs that a YAML's sweep section asks for, or one of them"""
    from rtcd_jax.cli.search_options import read_sweep
    from rtcd_jax.run.sweep import show, store

    cases, options = read_sweep(arguments, RUNS)
    if options.list:
        print(show(cases))
        return Exit.OK

    def run(console, cluster) -> None:
        from rtcd_jax.run.optimize import optimize as run_optimize

        failed = []
        for case in cases if options.case is None else [cases[options.case]]:
            console.message(f"case {case.number} of 0 … {len(cases) - 1}: {case.folder}")
            try:
                worked = run_optimize(case.config, case.folder, console, cluster)
                cluster.on_first(partial(_finish_page, case.folder, worked, console))
            except UserError as error:  # the others may do better
                console.message(f"case {case.number} ended early: {error}")
                failed.append(case.folder.name)
        cluster.on_first(lambda: console.message(f"{show(cases)}\n{store(cases, options.folder)}"))
        if failed:
            raise UserError(f"{len(failed)} of the cases ended early, see above: {', '.join(failed)}")

    return _on_cluster(options.machines, options.folder, run)


def _on_cluster(machines: Any, folder: Path, run: Callable[[Any, Any], None]) -> int:
    """Joins the other processes of `machines`, if any, and runs `run(console, cluster)`; the exit code."""
    prepare_jax(machines.cpu_devices, machines.cache)
    from rtcd_jax.system.cluster import Cluster, Lost, Preempted, join, part

    join(machines.coordinator, machines.num_processes, machines.process_id)  # before anything touches a device
    from rtcd_jax.system.console import Console, silent

    cluster = Cluster.of(machines.devices)
    cluster.heed()
    with Console() if cluster.first else silent() as console:
        try:
            cluster.meet()
            run(console, cluster)
        except Preempted:
            console.message(f"asked to stop (SIGTERM): saved in {folder}; the same command goes on")
            part()
            return Exit.PREEMPTED
        except Lost as error:
            say(f"rtcd: {error}; start all of them again by the same command, to go on")
            return Exit.LOST_PROCESS
    return Exit.OK


def scale(arguments: Sequence[str]) -> int:
    """measure what a generation costs against population and devices"""
    from rtcd_jax.cli.search_options import read_scale

    config, options = read_scale(arguments, RUNS)
    from rtcd_jax.analysis.scale.study import study
    from rtcd_jax.system.console import Console

    grid = options.counts("populations"), options.counts("devices")
    with Console() as console:
        study(options.config, config, *grid, options.repeats, options.folder, console)
    return Exit.OK


def verify(arguments: Sequence[str]) -> int:
    """simulate fresh random states of a run's funnels with independent integrators"""
    from rtcd_jax.cli.run_options import read_verify

    options = read_verify(arguments)
    prepare_jax()
    from rtcd_jax.analysis.verify.run import verify_run
    from rtcd_jax.system.console import Console

    with Console() as console:
        held = verify_run(options.run, options.states, options.seed, options.workers or cores(), console)
        _refresh(options.run, console)
    return Exit.OK if held else Exit.REFUTED


def report(arguments: Sequence[str]) -> int:
    """write a run's figures and its page, or compare several runs on one"""
    from rtcd_jax.cli.run_options import read_report

    options = read_report(arguments)
    from rtcd_jax.analysis.report import report as write_report
    from rtcd_jax.system.console import Console

    with Console() as console:
        page, *figures = write_report(options.runs, options.to, console)
        console.message(f"{page}, and {len(figures)} figures in {figures[0].parent}")
    return Exit.OK


def _refresh(run: Path, console: Any) -> None:
    """Brings the run's page up to date, if it has one. The verb's own results are stored already: no error ends it."""
    from rtcd_jax.analysis.report import refresh

    try:
        page = refresh(run, console)
    except UserError as error:
        console.message(f"{run / 'report.html'} does not show this yet: {error}")
    else:
        if page:
            console.message(f"{page} shows this, too")


def _finish_page(run: Path, changed: bool, console: Any) -> None:
    """Makes a finished run's page and figures, unless they are there and still true.

    The run is whole without them: what goes wrong here is told, and ends nothing.
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


def animate(arguments: Sequence[str]) -> int:
    """show the swing-up of a run's initial and best candidate as MP4 and GIF"""
    from rtcd_jax.cli.run_options import read_animate

    options = read_animate(arguments)
    prepare_jax()
    from rtcd_jax.analysis.animate.animate import animate_run
    from rtcd_jax.system.console import Console

    with Console() as console:
        animate_run(options.run, options.to, options.seed, console)
    return Exit.OK


def replay(arguments: Sequence[str]) -> int:
    """say whether a measured motion stayed inside a run's funnel"""
    from rtcd_jax.cli.run_options import read_replay

    options = read_replay(arguments)
    from rtcd_jax.analysis.replay.replay import replay_run
    from rtcd_jax.system.console import Console

    with Console() as console:
        kept = replay_run(
            options.run, options.file, options.elite, console, options.columns, options.start, options.unwrap
        )
    return Exit.OK if kept else Exit.REFUTED


def certify(arguments: Sequence[str]) -> int:
    """prove the funnels of a run's elites by sums of squares"""
    from rtcd_jax.cli.proof_options import read_certify

    options = read_certify(arguments)
    from rtcd_jax.certificate.prove.run import certify_run
    from rtcd_jax.system.console import Console

    with Console() as console:
        workers = options.workers or cores()
        whole = certify_run(options.run, options.elites, options.rung, workers, console, options.optimize_value)
        _refresh(options.run, console)
    return Exit.OK if whole else Exit.REFUTED


def export(arguments: Sequence[str]) -> int:
    """write the controller, its funnel monitor and the design of an elite for a lab"""
    from rtcd_jax.cli.run_options import read_export

    options = read_export(arguments)
    prepare_jax()
    from rtcd_jax.export import export_run
    from rtcd_jax.system.console import Console

    with Console() as console:
        export_run(options.run, options.elite, options.to, console, options.name)
    return Exit.OK


def disturb(arguments: Sequence[str]) -> int:
    """try a run's best elite and its initial candidate: off-nominal starts, pushes, wrong models, noise, delay"""
    from rtcd_jax.cli.run_options import read_disturb

    options = read_disturb(arguments)
    prepare_jax()
    from rtcd_jax.analysis.disturb import disturb_run
    from rtcd_jax.system.console import Console

    with Console() as console:
        disturb_run(options.run, options.states, options.seed, console)
        _refresh(options.run, console)
    return Exit.OK


def check(arguments: Sequence[str]) -> int:
    """check a certificate file by exact arithmetic, without any solver"""
    from rtcd_jax.certificate.check import main as check_main

    return check_main(arguments)


def falsify(arguments: Sequence[str]) -> int:
    """simulate a great many motions of what a certificate says is proved"""
    from rtcd_jax.cli.proof_options import read_falsify

    options = read_falsify(arguments)
    from rtcd_jax.certificate.falsify.falsify import falsify_file
    from rtcd_jax.system.console import Console

    with Console() as console:
        held = falsify_file(options.certificate, options.rollouts, options.seed, options.workers or cores(), console)
    return Exit.OK if held else Exit.REFUTED


def audit(arguments: Sequence[str]) -> int:
    """show where an external funnel fails, and project its nominal onto the dynamics for a proof"""
    from rtcd_jax.cli.proof_options import read_audit

    options = read_audit(arguments)
    from rtcd_jax.certificate.audit.audit import audit_funnel
    from rtcd_jax.certificate.audit.external import Cost, read_external
    from rtcd_jax.system.console import Console

    given = read_external(options.file, options.plant, options.numbers, options.funnel)
    cost = Cost.of(given, options.q, options.r, options.state_limits)
    with Console() as console:
        held = audit_funnel(given, cost, options.states, options.seed, options.out, console)
    return Exit.OK if held else Exit.REFUTED


VERBS: dict[str, Callable[[Sequence[str]], int]] = {
    "optimize": optimize,
    "sweep": sweep,
    "scale": scale,
    "verify": verify,
    "report": report,
    "animate": animate,
    "replay": replay,
    "certify": certify,
    "disturb": disturb,
    "export": export,
    "check": check,
    "falsify": falsify,
    "audit": audit,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb and returns the exit code.

    Without `arguments` it is all that this process does, and takes the process' own: it may leave at once, heeds
    interrupts, and ends quietly where nobody reads.
    """
    if arguments is None:
        return as_process(lambda: main(sys.argv[1:]))
    words = [word for word in arguments if word != DEBUG]
    debug = len(words) < len(arguments)
    try:
        return _command(words or ["--help"], debug)
    except SystemExit as stop:  # tyro's: help, or an option that is not there
        return int(stop.code or 0)
    except (Exception, KeyboardInterrupt) as error:
        return explain(error, debug)


def _command(words: Sequence[str], debug: bool) -> int:
    verb, *rest = words
    if verb in ("-h", "--help"):
        print(_usage())
        return Exit.OK
    if verb == "--version":
        print(_version())
        return Exit.OK
    if verb not in VERBS:
        raise UserError(f"unknown command {verb!r}; {closest(verb, tuple(VERBS))}")
    return VERBS[verb](rest)


def _usage() -> str:
    width = max(map(len, VERBS))
    return "\n".join(
        [
            "usage: rtcd COMMAND … [--debug]",
            "",
            "Robust co-design of underactuated robots.",
            "",
            *(f"  {name:{width}}  {verb.__doc__}" for name, verb in VERBS.items()),
            "",
            "`rtcd COMMAND --help` lists a command's options; `rtcd --version` prints the version.",
            "",
            "Exit codes:",
            *(f"  {code:3d}  {code.meaning}" for code in Exit),
        ]
    )


def _version() -> str:
    from importlib.metadata import version

    return f"rtcd {version('rtcd-jax')}"


if __name__ == "__main__":
    sys.exit(main())
