"""Options of certify, falsify, audit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rtcd_jax.cli.checks import require_at_least, require_run
from rtcd_jax.cli.search_options import OPTIMIZE_USAGE
from rtcd_jax.system.errors import UserError


@dataclass(frozen=True)
class CertifyOptions:
    """Prove the funnels of a run's best elites by sums of squares; `rtcd check` checks what this writes.

    Rungs: certified, by the solver's floating-point numbers; proved, by exact arithmetic for the true dynamics. The
    same command goes on after a kill. Exit code 1 if a funnel was not shown from t = 0 to the goal.

    Example: rtcd certify checkpoints/pendulum_rtcd --elites 8 --optimize_value
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="the run folder")]
    elites: Annotated[int, tyro.conf.arg(help="how many, the best first [-] (>= 1)")] = 1
    rung: Annotated[Literal["certified", "proved"], tyro.conf.arg(help="how much is to be shown")] = "proved"
    optimize_value: Annotated[bool, tyro.conf.arg(help="choose the ellipsoids' shapes too")] = False
    workers: Annotated[int, tyro.conf.arg(help="processes, one elite each; 0 for one a core [-] (>= 0)")] = 0


@dataclass(frozen=True)
class FalsifyOptions:
    """Simulate motions from the boundary and the inside of what a certificate says is proved, at instants all over it.

    Equations and integrator share nothing with the proof. Exit code 1 if a motion leaves the funnel, a limit or the
    goal region, beyond the integrator's own error, which is measured. The same command goes on after a kill.

    Example: rtcd falsify checkpoints/pendulum_rtcd/certificates/000.json --rollouts 100000
    """

    certificate: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="a certificate, or a run folder (its 000)")
    ]
    rollouts: Annotated[int, tyro.conf.arg(help="motions to simulate [-] (>= 1)")] = 1_000_000
    seed: Annotated[int, tyro.conf.arg(help="of their starts [-] (>= 0)")] = 0
    workers: Annotated[int, tyro.conf.arg(help="processes, 0 for one a core [-] (>= 0)")] = 0


@dataclass(frozen=True)
class AuditOptions:
    """Simulate an external funnel, knot by knot, and project its nominal motion onto the dynamics for a proof.

    FILE is a table: after a row of headings one row a knot, with the time, the states, the input held until the next
    knot, rho, and the upper triangle of S; or the trajectory alone, and --funnel has rho and all of S. The gains are
    R^-1 B'S. Exit code 1 if a state left the funnel.

    Example: rtcd audit funnel.csv --plant pendulum --parameters m=0.7 l=0.4 b=0.1 g=9.81 torque_limit=2.5
    --q 10 1 --r 0.1 --out checkpoints/audit
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="the trajectory and its funnel")]
    plant: Annotated[str, tyro.conf.arg(help="pendulum or cartpole")]
    parameters: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE …", help="its physical numbers [SI]")]
    q: Annotated[tuple[float, ...], tyro.conf.arg(help="diagonal of the cost's Q [1/(s state's unit^2)]")]
    r: Annotated[float, tyro.conf.arg(help="the cost's R [1/(s input's unit^2)]")]
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="where the audit and the elites are stored")]
    funnel: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help="rho and S row by row, a knot a column (or a row)")
    ] = None
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


def read_certify(arguments: Sequence[str]) -> CertifyOptions:
    """The checked options of `rtcd certify`; `UserError` if one is out of range."""
    options = tyro.cli(CertifyOptions, args=arguments, prog="rtcd certify", use_underscores=True)
    require_at_least(options, elites=1, workers=0)
    require_run(options.run, OPTIMIZE_USAGE)
    return options


def read_falsify(arguments: Sequence[str]) -> FalsifyOptions:
    """The checked options of `rtcd falsify`; `UserError` if one is out of range."""
    options = tyro.cli(FalsifyOptions, args=arguments, prog="rtcd falsify", use_underscores=True)
    require_at_least(options, rollouts=1, seed=0, workers=0)
    if options.certificate.is_dir():
        return replace(options, certificate=options.certificate / "certificates" / "000.json")
    return options


def read_audit(arguments: Sequence[str]) -> AuditOptions:
    """The checked options of `rtcd audit`; `UserError` if one is out of range."""
    options = tyro.cli(AuditOptions, args=arguments, prog="rtcd audit", use_underscores=True)
    require_at_least(options, states=1, seed=0)
    return options
