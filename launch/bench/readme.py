"""Prints the tables of results in README.md and docs/results.md from stored runs, so that no two of them disagree.

    python launch/bench/readme.py checkpoints/pendulum_rtc checkpoints/pendulum_rtcd checkpoints/cartpole_rtc
    python launch/bench/readme.py … --check README.md docs/results.md    # exit code 1: rows that stand in neither

Every run is read as `rtcd report` reads it, its certificates checked. Ratios are to the initial candidate's sum as the
run sampled it; a proved one only from t = 0 on.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from rtcd_jax.analysis.report.publication import PAPER
from rtcd_jax.analysis.report.reading import Run, read_run
from rtcd_jax.analysis.report.words import words
from rtcd_jax.elite.elite import Elite

SHORT = ("volume sum over the initial candidate's", "the paper", "rtcd_jax, sampled", "proved")
LONG = (
    "candidate",
    "design",
    "diag Q, R",
    "sum",
    "× initial",
    "integral",
    "inlet",
    "geometric mean",
    "largest knot's share",
)
NONE = ""


def label(run: Run) -> str:
    """`pendulum RTC-D, with mass and length`: the robot, what is searched beside the weights, another objective."""
    free = [words(name) for name, variable in run.config.design.items() if variable.free]
    options = {name: value for name, value in run.best.record["policy"].items() if value != _default(run, name)}
    searched = f"RTC-D, with {' and '.join(free)}" if free else "RTC, the weights alone"
    policy = f"; {', '.join(f'{words(name)} {value:.3g}' for name, value in options.items())}" if options else ""
    objective = run.config.search.objective
    return f"{run.config.plant.name} {searched}{policy}" + ("" if objective == "sum" else f", objective {objective}")


def _default(run: Run, name: str) -> float | None:
    return type(run.config.policy)().initial().get(name)


def short(run: Run) -> tuple[str, ...]:
    """README's row."""
    before = run.initial.volumes["sum"] if run.initial else 0.0
    free = any(variable.free for variable in run.config.design.values())
    paper = PAPER.get((run.config.plant.name, free)) if run.config.search.objective == "sum" else None
    certificate = run.certificates.get("000")
    proved = (
        certificate.shown["sum"]
        if certificate and certificate.guarantee == "proved" and not certificate.start
        else None
    )
    return label(run), _number(paper), _ratio(run.best.volumes["sum"], before), _ratio(proved, before)


def long(runs: Sequence[Run]) -> Iterator[tuple[str, ...]]:
    """The rows of docs/results.md: each initial candidate once, then the best ones."""
    told = set[str]()
    for run in runs:
        before = run.initial.volumes["sum"] if run.initial else 0.0
        if run.initial and (row := _candidate("initial (paper)", run.initial, before)) and row[3] not in told:
            told.add(row[3])
            yield row
        yield _candidate(f"**{label(run)}**", run.best, before)


def _candidate(name: str, elite: Elite, before: float) -> tuple[str, ...]:
    record = elite.record
    weights = (*record["weights"]["q"], *record["weights"]["r"])
    volumes = [_number(elite.volumes.get(each)) for each in ("sum", "integral", "inlet", "geometric_mean")]
    share = 100 * record["volumes"]["share_of_largest_knot"]
    return (
        name, ", ".join(f"{value:.3g}" for value in record["design"].values()), ", ".join(f"{w:.3g}" for w in weights),
        volumes[0], _ratio(elite.volumes["sum"], before), *volumes[1:], f"{share:.2g} %",
    )  # fmt: skip


def _number(value: float | None) -> str:
    return NONE if value is None else f"{value:.4g}"


def _ratio(after: float | None, before: float) -> str:
    return NONE if after is None or before <= 0 else f"{after / before:.3g}"


def row(cells: Sequence[str]) -> str:
    """As Markdown has it."""
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Prints both tables, or the rows that the given documents lack."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--check", nargs="+", type=Path, default=[], metavar="FILE")
    options = parser.parse_args()
    runs = [read_run(path) for path in options.runs]
    tables = {SHORT: [row(short(run)) for run in runs], LONG: [row(cells) for cells in long(runs)]}
    if options.check:
        text = "\n".join(path.read_text(encoding="utf-8") for path in options.check)
        missing = [line for rows in tables.values() for line in rows if line not in text]
        print("\n".join(missing) or "every row stands there")
        return int(bool(missing))
    for heads, rows in tables.items():
        print("\n".join([row(heads), row(["---"] * len(heads)), *rows, ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
