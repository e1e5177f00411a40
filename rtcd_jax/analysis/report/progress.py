"""Charts of a search: volumes, failures and step size over the generations, every variable's course, compared runs."""

from collections.abc import Mapping, Sequence

import numpy as np

from rtcd_jax.analysis.report.canvas import BLACK, GRAY
from rtcd_jax.analysis.report.charts import Band, Chart, Curve, Panel, Shares, Style, more_than_a_decade
from rtcd_jax.analysis.report.history import QUANTILES, column, courses, failures, feasible_volumes, front, spread
from rtcd_jax.analysis.report.reading import BLUE, VERMILION, Run
from rtcd_jax.analysis.report.words import volume_unit, words

GREEN = "#009E73"
STATUS_COLORS = {
    "OK": "#DCE4EE",
    "TRAJECTORY_NOT_SOLVED": "#E69F00",
    "RICCATI_INDEFINITE": "#CC79A7",
    "FUNNEL_EMPTY": "#56B4E9",
    "TOO_STIFF": "#F0E442",
    "NOT_FINITE": "#000000",
}
SPREAD = f"{QUANTILES[0]} to {QUANTILES[1]} % of the population"
SIGMA = (
    "the step size σ is the population's standard deviation along its widest axis. It rises while a generation's step "
    "goes on in the last one's direction: on the way to a distant optimum, and in a corner of the box, where a "
    "candidate beyond it counts as one on it. It falls once the steps turn about an optimum"
)
"""Why a step size rises at first."""
SEARCHES: Mapping[str, tuple[Style, float]] = {"best_so_far": ("solid", 1.8), "median": ("dotted", 1.0)}
"""What is compared of searches, and how its lines look."""


def charts(runs: Sequence[Run]) -> dict[str, Chart]:
    """The charts of one run's search, or of several compared ones, by name; none where nothing was searched."""
    if len(runs) > 1:
        return {"convergence": compared_convergence(runs)}
    if not runs[0].generations:
        return {}
    found = {"convergence": convergence(runs[0]), "courses": variables(runs[0])}
    conflicting = conflicts(runs[0])
    return found | ({"conflicts": conflicting} if conflicting.panels else {})


def convergence(run: Run) -> Chart:
    """Volumes, candidates by status and step size over the generations; restarts are marked."""
    generations, search = run.generations, run.config.search
    index, sigma = column(generations, "index"), column(generations, "sigma")
    best_so_far, best, median = (column(generations, name) for name in ("best_so_far", "best", "median"))
    low, high = spread(generations)
    marks = [
        Band(index, low, high, f"{SPREAD} with a funnel", GREEN),
        Curve(index, best_so_far, "best so far", VERMILION),
        Curve(index, best, "best", BLUE, style="points"),
        Curve(index, median, "median", GREEN, style="dashed"),
    ]
    label = f"volume ({words(search.objective)}) [{volume_unit(run.config, search.objective)}]"
    title = f"{run.config.plant.name}, {search.mode} search, population {search.population}, seed {search.seed}"
    logarithmic = more_than_a_decade(best_so_far, best, median)
    statuses = {
        status_words(name): (100 * share, STATUS_COLORS.get(name, GRAY))
        for name, share in failures(generations).items()
    }
    panels = [
        Panel(label, marks, title, logarithmic, height=3),
        Panel("candidates\nby status [%]", [Shares(index, statuses)], window=(0, 100), height=1.2),
        Panel(
            "step size σ\n[box widths]",
            [Curve(index, sigma, "", BLACK, style="marked")],
            logarithmic=more_than_a_decade(sigma),
        ),
    ]
    restarts = index[np.diff(column(generations, "restarts"), prepend=0) > 0].tolist()
    note = "sampled, as the search saw it"
    return Chart("Search", "generation", panels, 5.8, note, SIGMA, events=restarts, event="restart")


def variables(run: Run) -> Chart:
    """Every searched variable over the generations, in its own unit, between the ends of its box."""
    index, panels = column(run.generations, "index"), []
    for course in courses(run.config, run.generations):
        initial = np.full(len(index), course.variable.initial)
        marks = [
            Band(index, course.low, course.high, SPREAD, GREEN),
            Curve(index, course.median, "median", GREEN, style="dashed"),
            Curve(index, course.best, "best of the generation", VERMILION, style="points"),
            Curve(index, initial, "initial", BLUE, style="dotted", width=1),
        ]
        panels.append(Panel("", marks, course.title, course.logarithmic, course.window))
    rows = -(-len(panels) // 2)
    return Chart("Design and weights", "generation", panels, 1.9 * rows + 0.4, columns=2)


def conflicts(run: Run) -> Chart:
    """Pareto fronts of all candidates: the searched volume and each of the others that gains where it is given away."""
    objective = run.config.search.objective
    volumes, panels = feasible_volumes(run.generations), []
    for name, values in volumes.items():
        if name == objective or not values.size:
            continue
        x, y = front(volumes[objective], values)
        if x.size > 1:
            label = f"{words(name)}\n[{volume_unit(run.config, name)}]"
            panels.append(Panel(label, [Curve(x, y, "front", VERMILION, style="marked")]))
    label = f"{words(objective)} [{volume_unit(run.config, objective)}]"
    note = "sampled, as the search saw it: no candidate is larger in both volumes than one of a front"
    return Chart("What conflicts", label, panels, 1.5 * len(panels) + 0.5, note)


def compared_convergence(runs: Sequence[Run]) -> Chart:
    """Several searches over their candidates, each by its own objective: volumes above, feasible shares below."""
    volumes, feasible = [], []
    for run in runs:
        evaluated = column(run.generations, "evaluations")
        for name, (style, width) in SEARCHES.items():
            first = name == "best_so_far"
            label = f"{run.name} ({words(run.config.search.objective)})" if first else f"{run.name}, {words(name)}"
            values = column(run.generations, name)
            volumes.append(Curve(evaluated, values, label, run.color, style, width, run.name))
        label, share = f"{run.name}, feasible", 100 * column(run.generations, "feasible")
        feasible.append(Curve(evaluated, share, label, run.color, width=1.0, group=run.name))
    units = ", ".join(sorted({volume_unit(run.config, run.config.search.objective) for run in runs}))
    logarithmic = more_than_a_decade(*(curve.y for curve in volumes))
    panels = [
        Panel(f"volume [{units}]", volumes, logarithmic=logarithmic, height=3),
        Panel("with a funnel [%]", feasible, window=(0, 103)),
    ]
    note = "sampled, each search's own objective: solid the best so far, dotted each generation's median"
    return Chart("Search", "candidates", panels, 4.6, note)


def status_words(name: str) -> str:
    """A status in words."""
    return "has a funnel" if name == "OK" else words(name).lower()
