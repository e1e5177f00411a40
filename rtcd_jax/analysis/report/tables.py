"""Tables of the page: what a run has searched, proved, verified, and where it came from."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast, final

from rtcd_jax.analysis.report.history import OPTIONS, feasible_volumes
from rtcd_jax.analysis.report.reading import Experiment, Run, Tolerance
from rtcd_jax.analysis.report.words import duration, listed, ratio, volume_unit, words
from rtcd_jax.volume import VOLUMES

Cell = str | float | int | None


@final
@dataclass(frozen=True)
class Table:
    """Rows under headings; numbers stay numbers, so that columns can be sorted."""

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @property
    def numeric(self) -> list[bool]:
        """Of every column, whether it has numbers alone."""
        columns = [[row[i] for row in self.rows if row[i] is not None] for i in range(len(self.heads))]
        return [bool(column) and not any(isinstance(cell, str) for cell in column) for column in columns]


def gains(runs: Sequence[Run]) -> Table:
    """Table I of the paper, (initial, optimal, ratio, time), for all volumes and guarantees."""
    heads = (*_run_head(runs), "volume", "unit", "initial", "optimal", "ratio", "time", "guarantee")
    return Table(heads, tuple((*_run_cell(runs, run), *row) for run in runs for row in _gains_of(run)))


def comparison(runs: Sequence[Run]) -> Table:
    """One row a run: what it searched, its best candidate, with whose proof."""
    units = runs[0].config.design_units
    heads = (
        "run", "searched", *(f"{words(name)} [{unit}]" for name, unit in units.items()),
        *_weight_heads(runs[0]), *(OPTIONS[name] for name in _searched_options(runs)), *map(words, VOLUMES),
        "sum × initial", "guarantee", "sum shown", "guarantee shown", "promise",
        "time",
    )  # fmt: skip
    return Table(heads, tuple(_compared(run, _searched_options(runs)) for run in runs))


def elites(run: Run) -> Table:
    """The archive, best first."""
    units, options = run.config.design_units, _searched_options([run])
    shown = {
        name: (certificate.shown["sum"], certificate.guarantee)
        for name, certificate in run.certificates.items()
        if certificate.shown
    }
    varied, compared = (any(record.get(key) for record in run.elites.values()) for key in ("spread", "mjx"))
    heads = (
        "elite", *(f"{words(name)} [{unit}]" for name, unit in units.items()), *_weight_heads(run),
        *(OPTIONS[name] for name in options),
        *(f"{words(name)} [{volume_unit(run.config, name)}]" for name in VOLUMES), "sum × initial",
        "largest knot [%]", "swing-up [s]", "ε", "guarantee", *(["spread of sum [%]"] if varied else []),
        *(["MJX − closed form"] if compared else []), *(["sum shown", "guarantee shown"] if shown else []),
    )  # fmt: skip
    before = run.initial.volumes["sum"] if run.initial else 0.0
    rows = []
    for name, record in run.elites.items():
        volumes = record["volumes"]
        weights = (*record["weights"]["q"], *record["weights"]["r"])
        row = (
            name, *record["design"].values(), *weights, *(record["policy"][name] for name in options),
            *(volumes.get(key) for key in VOLUMES),
            ratio(volumes["sum"], before), 100 * volumes["share_of_largest_knot"], record["duration"],
            record["epsilon"], record["rung"],
            *([_percent(record.get("spread"))] if varied else []),
            *([(record.get("mjx") or {}).get("difference")] if compared else []),
        )  # fmt: skip
        rows.append((*row, *shown.get(name, (None, None))) if shown else row)
    return Table(heads, tuple(rows))


GIVEN_AWAY = (0.0, 0.01, 0.02, 0.05, 0.1)
"""Shares of the searched volume."""


def conflicts(run: Run) -> Table | None:
    """What every other volume could be for a share of the searched one; None where nothing was searched."""
    objective = run.config.search.objective
    volumes = feasible_volumes(run.generations) if run.generations else {}
    others = [name for name in volumes if name != objective]
    if not others or not volumes[objective].size:
        return None
    columns = (f"largest {words(name)} [{volume_unit(run.config, name)}]" for name in others)
    heads = (f"of {words(objective)} given away [%]", *columns)
    rows = []
    for share in GIVEN_AWAY:
        allowed = volumes[objective] >= (1 - share) * volumes[objective].max()
        rows.append((100 * share, *(float(volumes[name][allowed].max()) for name in others)))
    return Table(heads, tuple(rows))


def _percent(spread: Mapping[str, Any] | None) -> float | None:
    """The sum's relative standard deviation over the random numbers [%]; only the best elite has one."""
    share = spread["volumes"]["sum"] if spread else None
    return None if share is None else 100 * share


def certificates(runs: Sequence[Run]) -> Table | None:
    """Proved volumes beside sampled ones, or why a certificate proves nothing; None where there is none."""
    heads = (
        *_run_head(runs), "elite", "guarantee", "from [s]", "intervals", "proving",
        "initial ellipsoid sampled", "initial ellipsoid shown", "sum sampled", "sum shown", "sum shown / sampled",
        "integral sampled", "integral shown",
    )  # fmt: skip
    rows = tuple((*_run_cell(runs, run), *row) for run in runs for row in _certified(run))
    return Table(heads, rows) if rows else None


def ranks(run: Run) -> tuple[float, int] | None:
    """Spearman's correlation of the sampled and the shown sums and the number of elites; None below three."""
    sums = [(each.sampled["sum"], each.shown["sum"]) for each in run.certificates.values() if each.shown]
    if len(sums) < 3:
        return None
    from scipy.stats import spearmanr

    return float(cast(Any, spearmanr(sums)).statistic), len(sums)


def verification(runs: Sequence[Run]) -> Table | None:
    """The outcomes of the independent simulators; None before `rtcd verify`."""
    heads = (
        *_run_head(runs), "funnel", "simulator", "states", "left funnel", "left limits", "missed goal",
        "failure rate", "at least", "at most", "promised", "confidence", "promise",
    )  # fmt: skip
    rows = []
    for run in runs:
        for name, record in run.verification.items():
            for simulator, outcome in record.get("witnesses", {}).items():
                counts = [outcome.get(key) for key in ("left_funnel", "left_limits", "missed_goal")]
                counts += [outcome.get(key) for key in ("rate", "rate_lower", "rate_upper")]
                promise = [record.get("epsilon"), record.get("confidence"), _verdict([outcome.get("kept")])]
                rows.append((*_run_cell(runs, run), name, simulator, record.get("states"), *counts, *promise))
    return Table(heads, tuple(rows)) if rows else None


def verdict(run: Run) -> str | None:
    """Whether the independent simulators refute any of the run's promises; None before `rtcd verify`."""
    return _verdict(record.get("kept") for record in run.verification.values()) if run.verification else None


def _verdict(not_refuted: Iterable[Any]) -> str:
    return "not refuted" if all(not_refuted) else "REFUTED"


ALL_SHARES, SHARES = ("off_nominal", "robustness"), ("recovered", "success")
"""Experiments of which every number of the summary is a share, and the names of shares in the others."""


def experiment(record: Experiment) -> Table:
    """An experiment's summary: a row for each of its mappings, or else one for each of its numbers.

    Shares are in %; of the robustness score what fails first, the best candidate's least share, comes first.
    """
    summary = record.summary
    if summary and all(isinstance(value, Mapping) for value in summary.values()):
        heads = list(dict.fromkeys(key for value in summary.values() for key in value))
        shares = {key for key in heads if record.name in ALL_SHARES or key in SHARES}
        if record.name == "robustness":
            last = list(summary.values())[-1]
            heads.sort(key=lambda key: (key != "score", value if _is_number(value := last.get(key)) else 1.0))
        rows = tuple(
            (words(name), *(_percents(value.get(key), key in shares) for key in heads))
            for name, value in summary.items()
        )
        return Table(("", *(f"{words(key)} [%]" if key in shares else words(key) for key in heads)), rows)
    return Table(("", ""), tuple((words(name), _cell(value)) for name, value in summary.items()))


def tolerance(run: Run, tolerated: Tolerance) -> Table:
    """The largest factor of each uncertainty that a funnel bears, and its volumes there."""
    volumes = [f"{words(name)} [{volume_unit(run.config, name)}]" for name in VOLUMES]
    heads = ("uncertainty", "unit", "half width", "largest factor", "borne", *volumes, "guarantee")
    keys = ("name", "unit", "half_width", "factor", "borne")
    rows = [
        (
            *(row.get(key) for key in keys),
            *(row.get("volumes", {}).get(name) for name in VOLUMES),
            row.get("guarantee", "sampled"),
        )
        for row in tolerated.rows
    ]
    return Table(heads, tuple(rows))


def provenance(runs: Sequence[Run]) -> Table:
    """Which program made the runs, where and when."""
    heads = (*_run_head(runs), "", "")
    return Table(heads, tuple((*_run_cell(runs, run), *row) for run in runs for row in _origin(run)))


def candidate(run: Run) -> str:
    """The best candidate's design, weights and searched options."""
    record = run.best.record
    design = [listed(name, value, run.config.design_units[name]) for name, value in record["design"].items()]
    weights = [listed(name, value) for name, value in record["weights"].items()]
    options = [listed(name, record["policy"][name]) for name in run.config.policy.variables()]
    return ", ".join([*design, *weights, *options])


def wall_time(run: Run) -> str | None:
    """Wall time of the run, None where it was not recorded."""
    return None if run.seconds is None else duration(run.seconds)


def _gains_of(run: Run) -> Iterator[tuple[Cell, ...]]:
    searched = run.config.search.objective
    order = (searched, *(name for name in VOLUMES if name != searched and name in run.best.volumes))
    for name in order:
        before, after = run.initial.volumes.get(name) if run.initial else None, run.best.volumes[name]
        label = f"{words(name)} (searched)" if name == searched else words(name)
        times = ratio(after, before) if before is not None else None
        yield label, volume_unit(run.config, name), before, after, times, wall_time(run), run.best.guarantee
    certificate = run.certificates.get("000")
    for name in order:
        if certificate and name in certificate.shown:
            unit, took = volume_unit(run.config, name), duration(certificate.seconds)
            yield words(name), unit, None, certificate.shown[name], None, took, certificate.guarantee


def _compared(run: Run, options: Sequence[str]) -> tuple[Cell, ...]:
    record, config = run.best.record, run.config
    certificate = run.certificates.get("000")
    before = run.initial.volumes["sum"] if run.initial else None
    return (
        run.name, f"{words(config.search.objective)}, {config.search.mode}", *record["design"].values(),
        *record["weights"]["q"], *record["weights"]["r"], *(record["policy"][name] for name in options),
        *(run.best.volumes.get(name) for name in VOLUMES),
        ratio(run.best.volumes["sum"], before) if before is not None else None, record["rung"],
        *((certificate.shown["sum"], certificate.guarantee) if certificate and certificate.shown else (None, None)),
        verdict(run), wall_time(run),
    )  # fmt: skip


def _certified(run: Run) -> Iterator[tuple[Cell, ...]]:
    for name, certificate in run.certificates.items():
        if not certificate.shown:
            yield name, f"none: {certificate.reason}", *[None] * 10
            continue
        sampled, shown = certificate.sampled, certificate.shown
        yield (
            name, certificate.guarantee, certificate.start, certificate.intervals, duration(certificate.seconds),
            sampled["inlet"], shown["inlet"], sampled["sum"], shown["sum"], ratio(shown["sum"], sampled["sum"]),
            sampled["integral"], shown["integral"],
        )  # fmt: skip


def _origin(run: Run) -> Iterator[tuple[Cell, ...]]:
    search = run.config.search
    yield "folder", str(run.path)
    yield "search", f"{search.mode}, {search.generations} generations of {search.population}, seed {search.seed}"
    yield "time", wall_time(run) or "not recorded"
    yield "configuration", run.provenance.get("config_hash")
    for number, start in enumerate(run.provenance.get("starts", ()), 1):
        where = f"{start.get('devices')} × {start.get('device')}, {start.get('precision')}, {start.get('system')}"
        spent = f", {duration(start['seconds'])}" if "seconds" in start else ""
        yield f"start {number}", f"{start.get('time')}{spent}, commit {start.get('commit')}, {where}"
        versions = ", ".join(f"{name} {version}" for name, version in start.get("versions", {}).items())
        yield f"versions {number}", versions


def _searched_options(runs: Sequence[Run]) -> list[str]:
    """The policy's options that any of the runs searched."""
    return [name for name in OPTIONS if any(name in run.config.policy.variables() for run in runs)]


def _weight_heads(run: Run) -> list[str]:
    return [f"{letter}{i + 1}" for letter, variables in run.config.weights for i in range(len(variables))]


def _percents(value: Any, share: bool) -> Cell:
    return 100 * value if share and _is_number(value) else _cell(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _run_head(runs: Sequence[Run]) -> tuple[str, ...]:
    return ("run",) if len(runs) > 1 else ()


def _run_cell(runs: Sequence[Run], run: Run) -> tuple[str, ...]:
    return (run.name,) if len(runs) > 1 else ()


def _cell(value: Any) -> Cell:
    """What a table can hold: numbers and words as they are, all else as JSON."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if value is None or isinstance(value, str | float | int) else json.dumps(value, ensure_ascii=False)
