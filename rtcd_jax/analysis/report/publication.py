"""Table I of the paper from stored runs, as LaTeX, CSV or Markdown: initial and best candidates, the paper's beside."""

import csv
import io
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from rtcd_jax.analysis.report.reading import Run, compared
from rtcd_jax.analysis.report.tables import candidate
from rtcd_jax.analysis.report.words import listed, volume_unit, words
from rtcd_jax.config.load import differences
from rtcd_jax.elite.elite import Elite
from rtcd_jax.volume import VOLUMES

Form = Literal["latex", "csv", "md"]
Rows = list[tuple[str, ...]]

PAPER = {("pendulum", False): 3.18, ("pendulum", True): 3.90, ("cartpole", False): 2.17}
"""Sum over the initial candidate's, by robot and whether the design is searched (arXiv 2403.10966, table I)."""
NONE = "-"
_LATEX = str.maketrans({
    "&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "\\": r"\textbackslash{}", "±": r"$\pm$", "×": r"$\times$", "²": r"$^2$", "³": r"$^3$",
    "⁴": r"$^4$", "·": r"$\cdot$",
})  # fmt: skip


def table_of(runs: Sequence[Run], form: Form) -> str:
    """The table of finished runs of one robot; runs that differ in their seed alone share a row, mean ± spread.

    The spread is the standard deviation over the seeds. Volumes are sampled unless the guarantee says otherwise; the
    estimator's own spread of the sum, over random numbers, stands beside.

    Raises:
        UserError: runs of different robots.
    """
    runs = compared(runs)
    config = runs[0].config
    names = [name for name in VOLUMES if all(name in run.best.volumes for run in runs)]
    heads = (
        "candidate", "design and weights", *(f"{words(name)} [{volume_unit(config, name)}]" for name in names),
        "sum × initial", "the paper's", "spread of the estimate [%]", "guarantee",
    )  # fmt: skip
    rows: Rows = []
    for group in seeds(runs):
        run = group[0]
        if run.initial and (row := _row("initial", _initial(run), [run.initial], names)) not in rows:
            rows.append(row)
        best = max(group, key=lambda run: run.best.volumes[run.config.search.objective])
        name = run.name if len(group) == 1 else f"{run.name} ({len(group)} seeds)"
        gains = [run.best.volumes["sum"] / run.initial.volumes["sum"] for run in group if run.initial]
        searched = any(variable.free for variable in run.config.design.values())
        paper = PAPER.get((config.plant.name, searched))
        rows.append(
            _row(
                name,
                candidate(best),
                [run.best for run in group],
                names,
                gains,
                NONE if paper is None else f"{paper:.2f}",
            )
        )
    return FORMS[form](heads, rows)


def seeds(runs: Sequence[Run]) -> list[list[Run]]:
    """The runs in groups whose configurations are equal but for the seed, in the order of their first ones."""
    groups: list[list[Run]] = []
    for run in runs:
        alike = [group for group in groups if differences(group[0].config, run.config).keys() <= {"search.seed"}]
        if alike:
            alike[0].append(run)
        else:
            groups.append([run])
    return groups


def _initial(run: Run) -> str:
    values = {name: variable.initial for name, variable in run.config.design.items()}
    design = [listed(name, value, run.config.design_units[name]) for name, value in values.items()]
    weights = [listed(letter, [variable.initial for variable in found]) for letter, found in run.config.weights]
    return ", ".join([*design, *weights])


def _row(
    name: str,
    what: str,
    elites: Sequence[Elite],
    volumes: Sequence[str],
    gains: Sequence[float] = (),
    paper: str = NONE,
) -> tuple[str, ...]:
    numbers = [_mean([elite.volumes[volume] for elite in elites]) for volume in volumes]
    spreads = [elite.record["spread"]["volumes"]["sum"] for elite in elites if elite.record.get("spread")]
    estimate = f"{100 * max(spreads):.2g}" if spreads and None not in spreads else NONE
    guarantees = ", ".join(dict.fromkeys(elite.guarantee for elite in elites))
    return name, what, *numbers, _mean(gains), paper, estimate, guarantees


def _mean(values: Sequence[float]) -> str:
    """Mean ± standard deviation, the value alone where there is one."""
    if not values:
        return NONE
    mean = f"{np.mean(values):.4g}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.2g}"


def _markdown(heads: Sequence[str], rows: Rows) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _csv(heads: Sequence[str], rows: Rows) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([heads, *rows])
    return text.getvalue().rstrip("\n")


def _latex(heads: Sequence[str], rows: Rows) -> str:
    """For the package booktabs."""
    head, *body = (" & ".join(cell.translate(_LATEX) for cell in line) + r" \\" for line in [heads, *rows])
    columns = "ll" + "r" * (len(heads) - 3) + "l"
    return "\n".join(
        [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}"]
    )


FORMS: dict[Form, Callable[[Sequence[str], Rows], str]] = {"latex": _latex, "csv": _csv, "md": _markdown}
