"""The architecture, held by the imports: one way between the layers, and heavy packages only where they belong."""

import ast
import graphlib
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "rtcd_jax"

# From the bottom up; a module imports from its own layer and those below it. A folder stands for all its modules.
LAYERS = (
    {"numerics", "system"},
    {"types", "volume"},  # the nouns, and the list of volumes that a configuration names
    {"config"},
    {"plants"},
    {
        "problem",
        "genome",
        "trajectory",
        "window",
        "policy",
        "adversary",
        "centers",
        "dirtrel",
        "rollout",
        "validation",
        "funnel",
        "reset",
        "evaluation",
        "refinement",
    },
    {"search", "elite"},
    {"run"},
    {"analysis", "certificate", "export"},
    {"cli"},
    {"__main__"},
)

# The steps of the algorithm: each imports from those before it.
STEPS = (
    "types", "problem", "genome", "trajectory", "window", "policy", "adversary", "rollout", "validation", "funnel",
    "volume", "reset", "evaluation", "refinement",
)  # fmt: skip

# Packages that only some modules may import.
OWNERS = {
    "mujoco": {
        "plants.model",
        "plants.mjx",
        "plants.lagrange",
        "plants.draft",
        "plants.drawing",
        "analysis.animate",
        "export.templates",
    },
    "cvxpy": {"certificate"},
    "clarabel": {"certificate"},
    "flint": {"certificate"},
    "orbax": {"run"},
    "evosax": {"search"},
    "optax": {"refinement"},
    "tensorboardX": {"run.live"},
    "wandb": {"run.live"},
    "rich": {"system.console"},
    "tyro": {"cli"},
    "yaml": {"config", "export"},
    "matplotlib": {"analysis"},
    "PIL": {"analysis"},
    "imageio_ffmpeg": {"analysis.animate"},
    "pydantic": {"config", "cli"},
    "pydantic_core": {"config"},
}

# What knows nothing of the project above it.
ALONE = {
    "numerics": {"numerics"},
    "system": {"system"},
    "search.cmaes": {"search.cmaes", "numerics", "system.errors"},
    "certificate.check": {"certificate.check"},
}

# Modules that must start fast, so that wrong input is refused at once.
QUICK = (
    "cli.main",
    "cli.search_verbs",
    "cli.options",
    "cli.run_verbs",
    "config",
    "config.load",
    "config.schema",
    "config.settings",
    "system.console",
    "system.errors",
    "volume",
    "certificate.check",
    "certificate.check_cpp.command",
)
HEAVY = {"jax", "jaxtyping", "equinox", "evosax", "mujoco", "orbax", "scipy", "numpy", "matplotlib", "cvxpy"}


@cache
def modules():
    """Every module's syntax tree by its dotted name inside the package; the package itself is the empty name."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text())
    return found


def imported(tree, top_level_only=False):
    """Dotted names of everything that a module imports, lazily too unless `top_level_only`."""
    nodes = _executed_on_import(tree) if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layers"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _executed_on_import(tree):
    for node in ast.iter_child_nodes(tree):
        for_types = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if not for_types and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield node
            yield from _executed_on_import(node)


def own(names):
    """Those of the package's modules that the imported names stand for."""
    for name in names:
        parts = name.split(".")
        if parts[0] == "rtcd_jax":
            inner = ".".join(parts[1:])
            yield inner if inner in modules() else ".".join(parts[1:-1])


def within(module, owners):
    """The owner that is the module or the nearest folder above it; None if there is none."""
    around = [owner for owner in owners if module == owner or module.startswith(f"{owner}.")]
    return max(around, key=len, default=None)


def layer(module):
    owner = within(module, set().union(*LAYERS))
    assert owner, f"rtcd_jax.{module} has no layer: give it one in LAYERS"
    return next(height for height, layer in enumerate(LAYERS) if owner in layer)


def below_the_package():
    return sorted(set(modules()) - {""})


@pytest.mark.parametrize("module", below_the_package())
def test_imports_point_downwards(module):
    upwards = [other for other in own(imported(modules()[module])) if other and layer(other) > layer(module)]
    assert upwards == []


@pytest.mark.parametrize("step", STEPS)
def test_a_step_imports_only_from_steps_before_it(step):
    later = [other for other in own(imported(modules()[step])) if other in STEPS[STEPS.index(step) + 1 :]]
    assert later == []


@pytest.mark.parametrize("module", below_the_package())
def test_packages_stay_with_their_owners(module):
    roots = {name.split(".")[0] for name in imported(modules()[module])}
    strays = [root for root in roots & OWNERS.keys() if not within(module, OWNERS[root])]
    assert strays == []


@pytest.mark.parametrize("module", [name for name in below_the_package() if within(name, ALONE)])
def test_some_know_nothing_of_the_rest(module):
    allowed = ALONE[within(module, ALONE)]
    strangers = [other for other in own(imported(modules()[module])) if not within(other, allowed)]
    assert strangers == []


def test_no_cycles():
    graph = {name: {other for other in own(imported(tree)) if other != name} for name, tree in modules().items()}
    graph.pop("")
    assert set(graphlib.TopologicalSorter(graph).static_order()) >= graph.keys()


def loaded_with(module):
    """Everything that importing a module imports at once, modules of the package followed."""
    seen, names, open_ends = set(), set(), {module, ""}
    while open_ends:
        current = open_ends.pop()
        seen.add(current)
        found = set(imported(modules()[current], top_level_only=True))
        names |= found
        parents = {parent for inner in own(found) for parent in _and_its_folders(inner)}
        open_ends |= parents - seen
    return names


def _and_its_folders(module):
    parts = module.split(".")
    return {".".join(parts[:length]) for length in range(1, len(parts) + 1)} & modules().keys()


@pytest.mark.parametrize("module", QUICK)
def test_what_must_start_fast_loads_nothing_heavy(module):
    assert {name.split(".")[0] for name in loaded_with(module)} & HEAVY == set()


def test_the_rules_see_what_they_forbid():
    tree = ast.parse(
        "import jax.numpy as jnp\ndef f():\n    from rtcd_jax.plants import mjx\nif TYPE_CHECKING:\n    import scipy\n"
    )
    assert set(imported(tree)) == {"jax.numpy", "rtcd_jax.plants.mjx", "scipy"}
    assert list(imported(tree, top_level_only=True)) == ["jax.numpy"]
    assert list(own(imported(tree))) == ["plants.mjx"]
    assert "jax" in loaded_with("plants.robot")
    assert layer("plants.mjx") < layer("funnel") < layer("cli")
    assert within("plants.mjx", OWNERS["mujoco"])
    assert not within("plants.robot", OWNERS["mujoco"])


def test_public_names_are_those_of_their_modules():
    import rtcd_jax
    from rtcd_jax import types
    from rtcd_jax.config import load

    assert {name: getattr(rtcd_jax, name) for name in rtcd_jax.__all__}.keys() <= set(dir(rtcd_jax))
    assert rtcd_jax.Candidate is types.Candidate
    assert rtcd_jax.load is load.load
    with pytest.raises(AttributeError, match="module 'rtcd_jax' has no attribute 'Candidates'"):
        _ = rtcd_jax.Candidates
