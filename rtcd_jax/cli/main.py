"""The console script `rtcd`: the table of its verbs.

Nothing but the standard library is imported before a verb is known, and nothing heavy before its options are right.
"""

import inspect
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from rtcd_jax.cli.exits import Exit, as_process, explain
from rtcd_jax.system.devices import prepare_jax
from rtcd_jax.system.errors import UserError, closest

if TYPE_CHECKING:
    from pathlib import Path

    from rtcd_jax.system.console import Console

DEBUG = "--debug"


@dataclass(frozen=True)
class Verb:
    """One verb: `MODULE:FUNCTION`, a function of its options and a console that returns the exit code.

    The model of the options is the annotation of its first parameter.
    """

    function: str
    help: str
    jax: bool = False
    """Whether JAX is prepared as usual before."""
    shown: bool = False
    """Whether the run's page shows the results, and is brought up to date."""

    def __call__(self, words: Sequence[str]) -> int:
        module, name = self.function.split(":")
        function = getattr(import_module(module), name)
        first, *others = inspect.signature(function, eval_str=True).parameters.values()
        if not others:  # reads the words itself
            return function(words)
        options = first.annotation.read(words, f"rtcd {name}")
        from rtcd_jax.system.compilation import announced
        from rtcd_jax.system.console import Console

        if self.jax:
            prepare_jax(cache=getattr(options, "cache", None))

        with Console() as console, announced(console) if self.jax else nullcontext():
            code = function(options, console)
            if self.shown:
                _refresh(options.run, console)
        return code


VERBS = {
    "optimize": Verb(
        "rtcd_jax.cli.search_verbs:optimize",
        "search for the design and the weights with the largest funnel, or resume a search",
    ),
    "configs": Verb("rtcd_jax.cli.search_verbs:configs", "list the packaged configurations, or print one"),
    "completion": Verb("rtcd_jax.cli.completion:completion", "print the script that completes commands in a shell"),
    "new": Verb("rtcd_jax.cli.search_verbs:new", "write a commented configuration for the robot of an MJCF"),
    "sweep": Verb(
        "rtcd_jax.cli.search_verbs:sweep", "make all the runs that a YAML's sweep section asks for, or one of them"
    ),
    "scale": Verb("rtcd_jax.cli.search_verbs:scale", "measure what a generation costs against population and devices"),
    "refine": Verb(
        "rtcd_jax.cli.run_verbs:refine",
        "refine gains and ellipsoids of a run's elites by gradients, under the run's uncertainty",
        jax=True,
        shown=True,
    ),
    "verify": Verb(
        "rtcd_jax.cli.run_verbs:verify",
        "simulate held-out states of a run's funnels with independent simulators",
        jax=True,
        shown=True,
    ),
    "list": Verb("rtcd_jax.cli.run_verbs:list_", "list the runs in a folder: how far, how large, how sure"),
    "show": Verb("rtcd_jax.cli.run_verbs:show", "say what a run is, found, proved, verified, and bears"),
    "diff": Verb("rtcd_jax.cli.run_verbs:diff", "compare two runs: configurations, best candidates, volumes"),
    "report": Verb(
        "rtcd_jax.cli.run_verbs:report", "write a run's figures and its page, or compare several runs on one"
    ),
    "animate": Verb(
        "rtcd_jax.cli.run_verbs:animate",
        "show the swing-up of a run's initial and best candidate as MP4 and GIF",
        jax=True,
        shown=True,
    ),
    "replay": Verb("rtcd_jax.cli.run_verbs:replay", "say whether a measured motion stayed inside a run's funnel"),
    "certify": Verb(
        "rtcd_jax.cli.run_verbs:certify", "prove the funnels of a run's elites by sums of squares", shown=True
    ),
    "disturb": Verb(
        "rtcd_jax.cli.run_verbs:disturb",
        "try a run's best elite and its initial candidate: off-nominal starts, pushes, wrong models, noise, delay",
        jax=True,
        shown=True,
    ),
    "tolerance": Verb(
        "rtcd_jax.cli.run_verbs:tolerance",
        "find how much of each uncertainty, and of all at once, an elite's funnel bears",
        jax=True,
        shown=True,
    ),
    "export": Verb(
        "rtcd_jax.cli.run_verbs:export",
        "write the controller, its funnel monitor and the design of an elite for a lab",
        jax=True,
    ),
    "check": Verb(
        "rtcd_jax.certificate.check_cpp.command:main",
        "check a certificate file by exact arithmetic, without any solver",
    ),
    "falsify": Verb(
        "rtcd_jax.cli.run_verbs:falsify", "simulate a great many motions of what a certificate says is proved"
    ),
    "audit": Verb(
        "rtcd_jax.cli.run_verbs:audit",
        "show where an external funnel fails, and project its nominal onto the dynamics for a proof",
    ),
}


def _refresh(run: "Path", console: "Console") -> None:
    """Brings the run's page up to date, if it has one. The verb's own results are stored already: no error ends it."""
    from rtcd_jax.analysis.report import refresh

    try:
        page = refresh(run, console)
    except UserError as error:
        console.message(f"{run / 'report.html'} does not show this yet: {error}")
    else:
        if page:
            console.message(f"{page} shows this, too")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one verb and returns the exit code.

    Without `arguments` it is all that this process does, and takes the process' own: it may leave at once, heeds
    interrupts, and ends quietly where its output is closed.
    """
    if arguments is None:
        os.environ["MPLBACKEND"] = "agg"  # figures are files; a notebook's own backend is not in every environment
        return as_process(lambda: main(sys.argv[1:]))
    words = [word for word in arguments if word != DEBUG]
    debug = len(words) < len(arguments)
    try:
        return _command(words or ["--help"])
    except SystemExit as stop:  # tyro's: help, or an option that is not there
        return int(stop.code or 0)
    except (Exception, KeyboardInterrupt) as error:
        return explain(error, debug)


def _command(words: Sequence[str]) -> int:
    verb, *rest = words
    if verb in ("-h", "--help"):
        print(_usage())
        return Exit.OK
    if verb == "--version":
        from importlib.metadata import version

        print(f"rtcd {version('rtcd-jax')}")
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
            *(f"  {name:{width}}  {verb.help}" for name, verb in VERBS.items()),
            "",
            "`rtcd COMMAND --help` lists a command's options; `rtcd --version` prints the version.",
            "",
            "Exit codes:",
            *(f"  {code:3d}  {code.meaning}" for code in Exit),
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
