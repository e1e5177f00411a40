"""Prints the tables of results in README.md and docs/results.md from stored runs, so that no two of them disagree.

    python launch/bench/readme.py checkpoints/pendulum_rtc checkpoints/pendulum_rtcd checkpoints/cartpole_rtc
    python launch/bench/readme.py … --check README.md docs/results.md    # exit code 1: rows that are none of theirs

Every run is read as `rtcd report` reads it, its certificates checked. Ratios are to the initial candidate's sum as the
run sampled it; a proved one only from t = 0 on. ± is the spread of the sum over further random numbers, 0.1 % where it
is less.
"""

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from measure import as_script

from rtcd_jax.analysis.report.publication import PAPER
from rtcd_jax.analysis.report.reading import Run, read_run
from rtcd_jax.analysis.report.words import words
from rtcd_jax.config.schema import PolicyConfig
from rtcd_jax.elite.elite import Elite

NONE = ""
Rows = Iterator[tuple[str, ...]]


def label(run: Run) -> str:
    """``pendulum_rtcd`: RTC-D, mass, length`: the run's name, what is searched beside the weights, what is special."""
    config = run.config
    free = [words(name) for name, variable in config.design.items() if variable.free]
    others = {
        "policy": bool(_options(run.best)),
        "uncertainty": not config.uncertainty.empty,
        "refined": bool(run.best.record.get("refinement")),
        "nested": config.search.mode == "nested",
    }
    told = [", ".join(["RTC-D", *free]) if free else "RTC"]
    told += [name for name, present in others.items() if present]
    told += [] if config.search.objective == "sum" else [f"objective {words(config.search.objective)}"]
    return f"`{run.name}`: {'; '.join(told)}"


def _options(elite: Elite) -> dict[str, float]:
    """The policy's options that are not the paper's."""
    standard = PolicyConfig().initial()
    return {name: value for name, value in elite.record["policy"].items() if value != standard.get(name)}


def gains(runs: Sequence[Run]) -> Rows:
    """README's: what a search gained, what of it is proved, and what the paper has."""
    yield "volume sum over the initial candidate's", "the paper", "rtcd_jax, sampled", "proved"
    for run in runs:
        free = any(variable.free for variable in run.config.design.values())
        as_there = run.config.search.objective == "sum" and not _options(run.best)
        paper = PAPER.get((run.config.plant.name, free)) if as_there else None
        certificate = run.certificates.get("000")
        whole = certificate and certificate.guarantee == "proved" and not certificate.start
        proved = certificate.shown["sum"] if certificate and whole else None
        yield label(run), _number(paper), _ratio(run, run.best.volumes["sum"]), _ratio(run, proved)


def candidates(runs: Sequence[Run]) -> Rows:
    """Every initial candidate once, before the best one of its run, in all volumes."""
    yield (
        "candidate", "design", "diag Q, R", "sum", "× initial", "integral", "inlet", "geometric mean", "push margin",
        "largest knot's share",
    )  # fmt: skip
    told = set[tuple[str, ...]]()
    for run in runs:
        initial = run.initial and _candidate("initial", run, run.initial)
        rows = [initial] if initial and initial[:4] not in told else []
        told.update(each[:4] for each in rows)
        yield from rows
        yield _candidate(label(run), run, run.best)


def _candidate(name: str, run: Run, elite: Elite) -> tuple[str, ...]:
    record = elite.record
    weights = ", ".join(f"{weight:.3g}" for weight in (*record["weights"]["q"], *record["weights"]["r"]))
    options = "".join(f"; {words(name)} {value:.2g}" for name, value in _options(elite).items())
    spread = _spread(elite)
    total, *others = (
        _number(elite.volumes.get(each), spread.get(each))
        for each in ("sum", "integral", "inlet", "geometric_mean", "push")
    )
    varied = f" ± {_percent(spread['sum'])}" if spread else ""
    share = f"{100 * record['volumes']['share_of_largest_knot']:.2g} %"
    design = ", ".join(f"{value:.3g}" for value in record["design"].values())
    return name, design, weights + options, total + varied, _ratio(run, elite.volumes["sum"]), *others, share


def proofs(runs: Sequence[Run]) -> Rows:
    """The best elites' sampled volumes, and the proved ones below them."""
    yield "best elite", "guarantee", "inlet", "sum", "integral", "goal region", "intervals"
    for run in runs:
        certificate = run.certificates.get("000")
        if certificate and certificate.shown:
            yield label(run), "sampled", *_shown(certificate.sampled), NONE
            yield label(run), f"**{certificate.guarantee}**", *_shown(certificate.shown), f"{certificate.intervals}"


def _shown(volumes: Mapping[str, float]) -> list[str]:
    return [_number(volumes.get(each)) for each in ("inlet", "sum", "integral", "goal")]


def disturbances(runs: Sequence[Run]) -> Rows:
    """What `rtcd disturb` saw of initial and best candidate."""
    yield (
        "run", "all pushes tolerated up to", "sudden ones", "pushes recovered", "score", "model errors survived",
        "arrived from the best's first ellipsoid × 4",
    )  # fmt: skip
    for run in runs:
        seen = {experiment.name: experiment.summary for experiment in run.experiments}
        if seen.keys() >= {"impulse", "push_margin", "robustness", "off_nominal"}:
            push, sudden, robust = seen["impulse"], seen["push_margin"], seen["robustness"]
            yield (
                label(run),
                *(_before_after({name: each[key] for name, each in summary.items()}, form) for summary, key, form in (
                    (push, "largest_at_all_times", "{:.2g}"), (sudden, "tolerated_at_all_times", "{:.2g}"),
                    (push, "recovered", "{:.0%}"), (robust, "score", "{:.1%}"), (robust, "model", "{:.0%}"),
                )),
                _before_after(seen["off_nominal"]["best ellipsoid x 4"], "{:.0%}"),
            )  # fmt: skip


def _before_after(values: Mapping[str, float | None], form: str) -> str:
    told = ["none" if values.get(name) is None else form.format(values[name]) for name in ("initial", "best")]
    return " → ".join(told)


TABLES = gains, candidates, proofs, disturbances


def _number(value: float | None, spread: float | None = None) -> str:
    """With the digits that its relative spread leaves, at most four; three where none is known."""
    if value is None:
        return NONE
    digits = 3 if spread is None else min(max(round(1 - math.log10(max(spread, 1e-9))), 1), 4)
    text = f"{value:#.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and value < 1e6 else text.replace(".e", "e").rstrip(".")


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.1g}'):g} %" if share >= 0.001 else "0.1 %"


def _ratio(run: Run, after: float | None) -> str:
    """To the initial candidate's sum, with the digits that this one's spread leaves."""
    if after is None or run.initial is None:
        return NONE
    return _number(after / run.initial.volumes["sum"], _spread(run.initial).get("sum"))


def _spread(elite: Elite) -> Mapping[str, float]:
    return (elite.record.get("spread") or {}).get("volumes", {})


def row(cells: Sequence[str]) -> str:
    """As Markdown has it."""
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Prints the tables, or the documents' rows that are none of them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--check", nargs="+", type=Path, default=[], metavar="FILE")
    options = parser.parse_args()
    runs = [read_run(path) for path in options.runs]
    tables = [[row(cells) for cells in table(runs)] for table in TABLES]
    if options.check:
        known, named = {line for rows in tables for line in rows}, tuple(f"| `{run.name}`: " for run in runs)
        lines = [line for path in options.check for line in path.read_text(encoding="utf-8").splitlines()]
        wrong = [line for line in lines if line.startswith(named) and line not in known]
        print("\n".join(wrong) or "every row of these runs is as printed")
        return int(bool(wrong))
    for head, *rows in tables:
        if rows:
            print("\n".join([head, "|---" * (head.count("|") - 1) + "|", *rows, ""]))
    return 0


if __name__ == "__main__":
    as_script(main)
