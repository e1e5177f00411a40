"""`rtcd report`: one HTML page that needs nothing but itself, and the same figures for print.

plotly.js, the data, style and script stand in the page, whose security policy forbids every request. Tables sort by
a click on a heading.
"""

import base64
import dataclasses
import html
import json
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path

from rtcd_jax.analysis.report import tables
from rtcd_jax.analysis.report.canvas import print_chart
from rtcd_jax.analysis.report.charts import Chart, table
from rtcd_jax.analysis.report.funnels import draw_funnels, draw_over, levels
from rtcd_jax.analysis.report.motion import charts_of_motion
from rtcd_jax.analysis.report.plots import planes_of
from rtcd_jax.analysis.report.progress import charts
from rtcd_jax.analysis.report.reading import Experiment, Run, Tolerance, compared, funnel_views, read_run
from rtcd_jax.analysis.report.tables import Cell, Table
from rtcd_jax.analysis.report.traces import plots_of
from rtcd_jax.analysis.report.words import NONE, duration, guarantee, ratio, volume_unit, words
from rtcd_jax.system.console import Console
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import replace

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the browser may do: run and show what is in the page."""

LONGEST = 40
"""Characters of a cell that is not wrapped."""
_NUMBER, _LONG = ' class="number"', ' class="long"'


def report(folders: Sequence[Path], to: Path | None = None, console: Console | None = None) -> list[Path]:
    """Writes the page of a finished run, or one that compares several, and its figures; the page's path first.

    Certificates that were not checked yet are checked first, and `console` shows how far that is.

    One run: `report.html` and `figures/` in its folder. Several: `comparison.html` beside the first folder, with
    `comparison.png` and `.pdf`. `to`, say NAME.html, is another path for the page; then one run's figures are in
    NAME_figures/ beside it, and the run's folder is only read.

    Raises:
        UserError: a folder that is no finished run's, runs of different robots, or a path that cannot be written.
    """
    runs = [read_run(folder, console) for folder in folders]
    if to is not None and to.is_dir():
        raise UserError(f"--to = {to}: must be a file, and this is a folder")
    if len(runs) == 1:
        (run,), page = runs, to or folders[0] / "report.html"
        drawn = draw_figures(dataclasses.replace(run, figures=to.with_name(f"{to.stem}_figures")) if to else run)
    else:
        runs = compared(runs)
        page = to or folders[0].resolve().parent / "comparison.html"
        drawn = draw_over(runs, page.parent, page.stem)
    replace(page, render(runs).encode())
    return [page, *drawn]


def refresh(folder: Path, console: Console | None = None) -> Path | None:
    """The run's page written anew, with what was proved, verified and tried since; None where there is no page.

    The figures beside it show none of that, and stay. Raises UserError as `report`.
    """
    page = folder / "report.html"
    if not page.is_file():
        return None
    replace(page, render([read_run(folder, console)]).encode())
    return page


def draw_figures(run: Run) -> list[Path]:
    """The figures of one run, NAME.png and .pdf in `run.figures`, and of charts NAME.csv; the figures' paths.

    Raises UserError if they cannot be written.
    """
    funnels = draw_over([run], run.figures, "overlay") + draw_funnels(run)
    note = guarantee(run.best.record)
    others = {"levels": levels(run.config, run.funnels, note), **charts_of_motion(run.config, run.funnels)}
    others |= charts([run])
    drawn = [path for name, chart in others.items() for path in print_chart(chart, run.figures, name)]
    for name, chart in others.items():
        replace(run.figures / f"{name}.csv", table(chart).encode())
    return funnels + drawn


def render(runs: Sequence[Run]) -> str:
    """The whole page."""
    title = html.escape(" and ".join(run.name for run in runs))
    views = funnel_views(runs)
    of_motion, of_search = charts_of_motion(runs[0].config, views), charts(runs)
    funnels = planes_of(runs[0].config, views) | plots_of("levels", levels(runs[0].config, views))
    figures = dict(funnels)
    for name, chart in {**of_motion, **of_search}.items():
        figures |= plots_of(name, chart)
    data = json.dumps(figures, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    body = "\n".join([_header(runs), *_sections(runs, list(funnels), of_motion, of_search)])
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n<link rel="icon" href="data:,">\n'
        f"<style>\n{_asset('page.css')}</style>\n<script>{_plotly()}</script>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        f'<script type="application/json" id="figures">{data}</script>\n<script>\n{_asset("page.js")}</script>\n'
        "</body>\n</html>\n"
    )


def _header(runs: Sequence[Run]) -> str:
    first = runs[0].config
    about = f"{first.plant.name}, {first.trajectory.knots} knots"
    if len(runs) == 1:
        search = first.search
        if runs[0].audited:
            about += "; an external funnel, audited"
        else:
            about += f"; {search.mode} search for the largest {words(search.objective)}, "
            about += f"{search.generations} generations of {search.population}"
            about += "" if runs[0].generations else ", whose lines are lost"
        cards = "".join(_card(*card) for card in _headlines(runs[0]))
        candidate = f'<p class="candidate">best: {html.escape(tables.candidate(runs[0]))}</p>'
    else:
        cards = "".join(
            _card(run.name, f"× {_four_digits(_gain(run, 'sum'))}", f"sum over its initial one, {run.best.guarantee}")
            for run in runs
        )
        candidate = ""
    names = " · ".join(html.escape(run.name) for run in runs)
    head = f'<h1>{names}</h1><p class="about">{html.escape(about)}</p>'
    return f'<header>{head}{candidate}<div class="cards">{cards}</div></header>'


def _headlines(run: Run) -> Iterator[tuple[str, str, str]]:
    """Name, value and remark of what is looked for first."""
    objective = run.config.search.objective
    for name in dict.fromkeys((objective, "sum", "inlet")):
        searched = ", searched" if name == objective else ""
        yield f"{words(name)} over initial", f"× {_four_digits(_gain(run, name))}", run.best.guarantee + searched
    yield "swing-up", duration(float(run.best.time[-1])), "of the best, start to goal"
    certificate = run.certificates.get("000")
    if certificate is None:
        yield "proof", "none yet", "rtcd certify"
    elif certificate.guarantee is None:
        yield "proof", "none", f"certificate {certificate.verdict}"
    else:
        yield "proof", certificate.guarantee, "of the best's funnel"
    verdict = tables.verdict(run)
    yield "verification", verdict or "none yet", "by independent simulators" if verdict else "rtcd verify"


def _gain(run: Run, volume: str) -> float | None:
    return ratio(run.best.volumes[volume], run.initial.volumes[volume]) if run.initial else None


def _card(name: str, value: str, remark: str) -> str:
    parts = (("span", name), ("strong", value), ("small", remark))
    return f'<div class="card">{"".join(f"<{tag}>{html.escape(text)}</{tag}>" for tag, text in parts)}</div>'


def _sections(
    runs: Sequence[Run], funnels: Sequence[str], of_motion: Mapping[str, Chart], of_search: Mapping[str, Chart]
) -> Iterator[str]:
    alone = runs[0] if len(runs) == 1 else None
    if alone is None:
        yield _section("Compared", _table(tables.comparison(runs)))
    yield _section("Funnels", *_funnels(runs, funnels))
    for name, chart in of_motion.items():
        yield _section(chart.title, *_charted(name, chart))
    promise = "" if alone is None else _note(f"The best funnel is {guarantee(alone.best.record)}.")
    advice = (
        "Ratios are optimal over initial. The sum counts knots, most of them near the goal: look at the initial "
        "ellipsoid too, that of the first knot, where disturbances come first; configurations call it the inlet."
    )
    yield _section("Initial and optimal", _table(tables.gains(runs)), promise, _note(advice))
    for name, chart in of_search.items():
        table = tables.conflicts(runs[0]) if name == "conflicts" else None
        yield _section(chart.title, *([_table(table)] if table else []), *_charted(name, chart))
    if alone:
        yield _section("Elites", _table(tables.elites(alone)), _note("Click a heading to sort."))
    yield _section("Certificates", *_certified(runs))
    verification = tables.verification(runs)
    yield _section("Verification", _table(verification) if verification else _note("Nothing yet: rtcd verify RUN."))
    for run in runs:
        for experiment in run.experiments:
            name = words(experiment.name) if alone else f"{words(experiment.name)}: {run.name}"
            yield _section(f"Disturbance: {name}", _table(tables.experiment(experiment)), *_pictures(experiment))
        for tolerated in run.tolerances:
            name = f"Tolerance: elite {tolerated.elite}" + ("" if alone else f" of {run.name}")
            yield _section(name, _table(tables.tolerance(run, tolerated)), *_pictures(tolerated))
    yield _section("Provenance", _table(tables.provenance(runs)))


def _charted(name: str, chart: Chart) -> Iterator[str]:
    """The places of a chart's plots, and its note."""
    if chart.columns == 1:
        yield _plot(name, ("", "tall", "taller")[min(len(chart.panels) // 3, 2)])
    else:
        yield f'<div class="grid">{"".join(_plot(each, "small") for each in plots_of(name, chart))}</div>'
    if chart.note:
        yield _note(f"{chart.note[0].upper()}{chart.note[1:]}.")


def _funnels(runs: Sequence[Run], names: Sequence[str]) -> Iterator[str]:
    for run in runs:
        if run.absence:
            yield _note(f"{run.name}: {run.absence}" if len(runs) > 1 else f"{run.absence}.")
    yield (
        '<label class="moment">ellipsoid at <output>0.00 s</output>'
        '<input type="range" min="0" max="1" step="0.002" value="0" aria-label="time along the motion"></label>'
    )
    *planes, levels = names
    yield f'<div class="grid wide">{"".join(map(_plot, planes))}</div>'
    yield _note(
        "Shadows of every knot's ellipsoid on the plane of a coordinate and its velocity. A click in the legend hides."
    )
    yield _plot(levels, "tall")
    for run in runs:
        if push := run.best.record.get("push"):
            whose = f"{run.name}: " if len(runs) > 1 else ""
            yield _note(whose + _push_margin(run, push))


def _push_margin(run: Run, push: Mapping[str, float | None]) -> str:
    """The statement that the margin makes, and what the limits on the states leave of any funnel."""
    unit = volume_unit(run.config, "push")
    most, limits = push["within_limits"], ""
    if most:
        limits = f"; there the limits on the states leave no more than {most:.3g} {unit}"
    return (
        f"Push margin ({run.best.guarantee}, at the knots): a motion on its nominal stays in the funnel "
        f"after an impulse of up to {push['margin']:.3g} {unit}; the least is that at {push['time']:.3g} s{limits}."
    )


def _certified(runs: Sequence[Run]) -> Iterator[str]:
    certificates = tables.certificates(runs)
    if certificates is None:
        yield _note("Nothing yet: rtcd certify RUN.")
        return
    yield _table(certificates)
    for run in runs:
        ranks = tables.ranks(run)
        if ranks:
            whose = f"{run.name}: " if len(runs) > 1 else ""
            correlation = f"rank correlation of sampled and shown sums over {ranks[1]} elites: {ranks[0]:.3f}"
            yield _note(whose + correlation)


def _pictures(experiment: Experiment | Tolerance) -> Iterator[str]:
    for path in (each for each in experiment.pictures if each.is_file()):
        data = base64.b64encode(path.read_bytes()).decode()
        picture = f'<img src="data:image/png;base64,{data}" alt="{html.escape(words(path.stem))}">'
        yield f'<div class="scroll">{picture}</div>'


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>\n{''.join(parts)}\n</section>"


def _plot(name: str, size: str = "") -> str:
    return f'<div class="plot {size}" data-figure="{name}"></div>'


def _note(text: str) -> str:
    return f'<p class="note">{html.escape(text)}</p>'


def _table(table: Table) -> str:
    heads = "".join(
        f'<th scope="col"{_NUMBER * numeric}><button type="button">{html.escape(head)}</button></th>'
        for head, numeric in zip(table.heads, table.numeric, strict=True)
    )
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, table.numeric))}</tr>" for row in table.rows)
    return f'<div class="scroll"><table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody></table></div>'


def _cell(value: Cell, numeric: bool) -> str:
    if isinstance(value, str):
        return f"<td{_LONG * (len(value) > LONGEST)}>{html.escape(value)}</td>"
    sorted_by = " data-none" if value is None else f' data-value="{value!r}"'
    return f"<td{_NUMBER * numeric}{sorted_by}>{_four_digits(value)}</td>"


def _four_digits(value: float | int | None) -> str:
    return NONE if value is None else f"{value}" if isinstance(value, int) else f"{value:.4g}"


def _asset(name: str) -> str:
    return resources.files("rtcd_jax.analysis.report").joinpath(name).read_text(encoding="utf-8")


def _plotly() -> str:
    """plotly.js, as its Python package brings it; only the file is read, which saves the import's second."""
    code = resources.files("plotly").joinpath("package_data/plotly.min.js").read_text(encoding="utf-8")
    return code.replace("</script", "<\\/script")
