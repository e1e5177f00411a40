"""What a GPU would have to launch for one candidate, counted in programs compiled for an H100, without a GPU.

XLA's whole GPU compiler runs on a CPU, given three wheels (224 MB, into a folder of their own) and the card's numbers
(h100.txtpb). What it makes is counted: kernels and copies times the trips of the loops around them, CUDA graphs, what
stands in a loop outside of a graph, temporaries, registers and spills. Nothing runs, so that nothing here is a time.
Trips that depend on the numbers are those of `gpu_budget.json` (measured by gpu_trips.py), which has the budget, too.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
CONFIGS = HERE.parents[1] / "configs"
BUDGET = HERE / "gpu_budget.json"
CARD = HERE / "h100.txtpb"
ARCHITECTURE = "sm_90a"


def wheels(folder: Path) -> None:
    """The compiler's three wheels, for the jax that is installed, in `folder`."""
    import jax

    names = [f"jax-cuda12-pjrt=={jax.__version__}", f"jax-cuda12-plugin=={jax.__version__}", "nvidia-cuda-nvcc-cu12"]
    if not (folder / "nvidia" / "cuda_nvcc").is_dir():
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder)]
        subprocess.run([*pip, *names], check=True)


def compile_for_gpu(config: Path, chunk: int, folder: Path) -> None:
    """Compiles a generation's evaluation of `chunk` candidates; prints the bytes that it needs as JSON."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.experimental import topologies
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    from rtcd_jax.config.load import load
    from rtcd_jax.evaluation import make_evaluate
    from rtcd_jax.numerics.loops import compiled_for
    from rtcd_jax.problem import make_problem

    jax.config.update("jax_enable_x64", True)
    sys.path.append(str(folder))  # jax finds its plugins on the path
    card = topologies.get_topology_desc(platform="cuda", target_config=CARD.read_text(), topology="1x1x1")
    one = NamedSharding(Mesh(np.array(card.devices).reshape(1), ("candidates",)), PartitionSpec())
    on_card = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=one)  # noqa: E731
    problem = make_problem(load(config))
    evaluate = make_evaluate(problem)
    genomes = jax.ShapeDtypeStruct((chunk, len(problem.free)), jnp.float64)
    key = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    with compiled_for("cuda"):
        program = jax.jit(lambda genomes, key: evaluate(genomes, jax.random.wrap_key_data(key)))
        compiled = program.trace(*map(on_card, (genomes, key))).lower().compile()
    memory = compiled.memory_analysis()
    assert memory is not None
    print(json.dumps({"temporaries": memory.temp_size_in_bytes, "results": memory.output_size_in_bytes}))


@dataclass
class Thunk:
    """One entry of the compiled sequence; a loop's `trips` are None where they depend on the numbers."""

    kind: str
    indent: int
    body: list["Thunk"] = field(default_factory=list)
    condition: list["Thunk"] = field(default_factory=list)
    trips: float | None = 1
    source: str = ""


def thunks(text: str) -> Thunk:
    """The tree of the sequence that XLA prints."""
    root = Thunk("root", -1)
    path, in_condition = [root], set()
    for line in filter(str.strip, text.splitlines()):
        indent, words = len(line) - len(line.lstrip()), line.strip()
        if words == "condition:":  # of the loop just above, whatever its own indent
            in_condition.add(id(path[-1]))
        elif words == "body:":  # two columns right of its loop
            while path[-1].indent > indent - 2:
                path.pop()
            in_condition.discard(id(path[-1]))
        elif match := re.match(r"\d+: (k\w+)", words):
            while path[-1].indent >= indent:
                path.pop()
            thunk = Thunk(match[1], indent)
            (path[-1].condition if id(path[-1]) in in_condition else path[-1].body).append(thunk)
            path.append(thunk)
    return root


def loops(hlo: str) -> Iterator[tuple[float | None, str]]:
    """Trips of every loop in the order in which the program's schedule comes to it, and the innermost of our files."""
    computations, name = {}, ""
    for line in hlo.splitlines():
        head = re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", line)
        if head and not line.startswith(" "):
            name = "ENTRY" if head[1] else head[2]
            computations[name] = []
        elif name and line.startswith("  "):
            computations[name].append(line)
    frames = Frames(hlo)

    def walk(name: str) -> Iterator[tuple[float | None, str]]:
        for line in computations[name]:
            operation = re.search(r" (while|conditional|call)\(", line)
            if not operation:
                continue
            if operation[1] == "while":
                trips = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
                frame = re.search(r"stack_frame_id=(\d+)", line)
                yield (float(trips[1]) if trips else None), frames.file(int(frame[1])) if frame else ""
            for called in re.findall(r"(?:body|to_apply|true_computation|false_computation)=%?([\w.\-]+)", line):
                yield from walk(called)
            for branches in re.findall(r"branch_computations=\{([^}]*)\}", line):
                for called in branches.split(","):
                    yield from walk(called.strip().lstrip("%"))

    return walk("ENTRY")


class Frames:
    """The tables of stack frames at an HLO text's head."""

    def __init__(self, hlo: str):
        def table(title: str) -> dict[int, str]:
            block = re.search(rf"^{title}\n((?:\d+ .*\n)*)", hlo, re.M)
            rows = (line.split(" ", 1) for line in block[1].splitlines()) if block else ()
            return {int(number): rest for number, rest in rows}

        self.names, self.locations, self.frames = map(table, ("FileNames", "FileLocations", "StackFrames"))

    def file(self, frame: int) -> str:
        """The innermost file of rtcd_jax, but for the loops themselves."""
        while frame in self.frames:
            numbers = {key: int(value) for key, value in re.findall(r"(\w+)=(\d+)", self.frames[frame])}
            location = self.locations.get(numbers.get("file_location_id", 0), "")
            file = re.search(r"file_name_id=(\d+)", location)
            path = self.names.get(int(file[1]), "") if file else ""
            if "rtcd_jax/" in path and not path.strip('"').endswith("numerics/loops.py"):
                return path.strip('"').rsplit("rtcd_jax/", 1)[1]
            parent = numbers.get("parent_frame_id", 0)
            if parent == frame:
                break
            frame = parent
        return ""


def counted(root: Thunk, trips: dict[str, float]) -> Counter:
    """Kernels and copies, graphs, syncs with the host, and slices in loops outside of graphs, of one chunk."""

    def branches(loop: Thunk) -> list[Thunk]:
        return [child for child in loop.body if child.kind == "kConditional"]

    def of(thunk: Thunk, in_graph: bool, in_loop: bool) -> Counter:
        total = Counter()
        for child in thunk.body:
            if child.kind == "kCommandBuffer":
                total += Counter(graphs=1) + of(child, True, in_loop)
            elif child.kind == "kWhile":
                if child.trips is None and child.source not in trips:
                    raise SystemExit(f"{BUDGET.name} has no trips of the loop of {child.source or 'an unknown file'}")
                times = child.trips if child.trips is not None else trips[child.source]
                body, condition = of(child, in_graph, True), of(Thunk("", 0, child.condition), in_graph, True)
                once = body + condition + Counter(syncs=int(not in_graph and child.trips is None))
                total += Counter({name: count * times for name, count in once.items()})
                for branch in branches(child):  # the lanes' refill: all lanes are filled once, and emptied once
                    total += of(branch, in_graph, True)
            elif child.kind == "kConditional":
                total += Counter(syncs=int(not in_graph))
            else:
                total["launches"] += 1
                total["outside"] += not in_graph
                total["slices_in_loops"] += in_loop and child.kind == "kDynamicSliceFusion"
        return total

    return of(root, False, False)


def with_trips(root: Thunk, found: list[tuple[float | None, str]]) -> None:
    """Every loop of the tree gets its trips and its source, which come in the same order."""
    rest = iter(found)

    def visit(thunk: Thunk) -> None:
        for child in thunk.body:
            if child.kind == "kWhile":
                child.trips, child.source = next(rest)
            visit(child)

    visit(root)
    if left := list(rest):
        raise SystemExit(f"{len(left)} loops of the program are not in its sequence: this XLA prints it otherwise")


def spills(folder: Path, dump: Path) -> tuple[int, int]:
    """The most registers of a kernel, and the most bytes that one spills, as ptxas reports them."""
    ptxas = folder / "nvidia" / "cuda_nvcc" / "bin" / "ptxas"
    ptxas.chmod(0o755)
    registers, spilled = 0, 0
    for source in dump.glob("*.ptx"):
        command = [str(ptxas), "-v", f"-arch={ARCHITECTURE}", "-o", os.devnull, str(source)]
        told = subprocess.run(command, capture_output=True, text=True, check=True).stderr
        registers = max(registers, *map(int, re.findall(r"Used (\d+) registers", told)), 0)
        spilled = max(spilled, *map(int, re.findall(r"(\d+) bytes spill stores", told)), 0)
    return registers, spilled


def trips_of(budget: dict, chunk: int) -> dict[str, float]:
    """Those of the largest measured chunk that is not larger, or of the smallest."""
    measured = sorted(map(int, budget["trips"]))
    return budget["trips"][str(max((size for size in measured if size <= chunk), default=measured[0]))]


def measure(config: Path, chunk: int, folder: Path, trips: dict[str, float]) -> dict[str, float]:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as place:
        dump = Path(place)
        from rtcd_jax.system.devices import GPU_FLAGS

        flags = [*GPU_FLAGS, f"--xla_dump_to={dump}", f"--xla_gpu_cuda_data_dir={folder / 'nvidia' / 'cuda_nvcc'}"]
        environment = os.environ | {"XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu"}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        command = [sys.executable, __file__, "--wheels", str(folder), "--one", str(config), str(chunk)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{config.name}, chunk {chunk}: the compiler failed:\n{done.stderr[-3000:]}")
        memory = json.loads(done.stdout.splitlines()[-1])
        sequence = max(dump.glob("*thunk_sequence_after_thunk_passes.txt"), key=lambda file: file.stat().st_size)
        name = sequence.name.split(".thunk_sequence")[0]
        (hlo,) = dump.glob(f"{name}.*gpu_after_optimizations.txt")
        root = thunks(sequence.read_text())
        with_trips(root, list(loops(hlo.read_text())))
        count = counted(root, trips)
        registers, spilled = spills(folder, dump)
    each = {name: count[name] / chunk for name in ("launches", "outside", "graphs", "syncs")}
    sizes = {f"{name}_kb": value / chunk / 1024 for name, value in memory.items()}
    return each | sizes | {"slices_in_loops": count["slices_in_loops"], "registers": registers, "spilled": spilled}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wheels", type=Path, default=HERE / ".wheels", help="folder of the compiler's wheels")
    parser.add_argument("--configs", nargs="+", default=["pendulum_rtcd", "cartpole_rtcd"])
    parser.add_argument("--chunks", type=int, nargs="+", default=[64, 4096, 65536])
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    folder = arguments.wheels.resolve()
    if arguments.one:
        compile_for_gpu(Path(arguments.one[0]), int(arguments.one[1]), folder)
        return
    wheels(folder)
    budgets, over = json.loads(BUDGET.read_text()), []
    print(f"{'configuration':16}{'chunk':>7}  launches, of these outside of graphs, graphs, host syncs a candidate …")
    for config in arguments.configs:
        budget = budgets[config]
        for chunk in arguments.chunks:
            row = measure(CONFIGS / f"{config}.yaml", chunk, folder, trips_of(budget, chunk))
            told = "  ".join(f"{name} {value:.4g}" for name, value in row.items())
            print(f"{config:16}{chunk:>7}  {told}", flush=True)
            over += [
                f"{config}, chunk {chunk}: {name} {row[name]:.4g} where at most {most:g} are allowed"
                for name, most in budget["at_most"].get(str(chunk), {}).items()
                if row[name] > most
            ]
    if over:
        raise SystemExit("\n".join(over))


if __name__ == "__main__":
    main()
