"""Equations of motion as a program of elementwise arithmetic, in two parts: once a design, and at every state.

While the program is written, every value is a sum of moving registers with coefficients that the design alone decides.
Products of coefficients stay coefficients, (a x) (b y) = (a b) (x y); zeros and ones are folded, signs are moved out,
and equal expressions are written once. So what is lumped of masses and lengths is computed once, in `Program.lump`, and
`Program.accelerations` is as short as equations written by hand. It takes any kind of numbers: JAX's, numpy's, or
others with the same arithmetic.
"""

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rtcd_jax.plants.lagrange import Equations
from rtcd_jax.plants.laurent import Laurent


@dataclass(frozen=True)
class Node:
    """A register of the program; `moving` if it depends on the state or the input."""

    index: int
    moving: bool


Number = float | Node


Sum = dict[Node | None, Number]
"""sum of coefficient * register; None stands for 1."""

ZERO: Sum = {}
ONE: Sum = {None: 1.0}


class Instruction(NamedTuple):
    target: int
    operation: str
    operands: tuple[Number, ...]


@dataclass(frozen=True)
class Program:
    """Registers hold the symbols, then positions, velocities and inputs, then what the instructions compute."""

    symbols: int
    registers: int
    lumping: tuple[Instruction, ...]
    lumped: tuple[int, ...]
    motion: tuple[Instruction, ...]
    outputs: tuple[Number, ...]

    def lump(self, symbols: Sequence[Any]) -> list[Any]:
        """What the accelerations need of a design, from the values of the symbols."""
        registers: list[Any] = [*symbols, *[None] * (self.registers - self.symbols)]
        _run(self.lumping, registers)
        return [registers[i] for i in self.lumped]

    def accelerations(
        self, lumped: Sequence[Any], q: Iterable[Any], v: Iterable[Any], u: Iterable[Any], sin: Callable, cos: Callable
    ) -> list[Any]:
        """v' of positions q, velocities v and inputs u; a float where it depends on nothing."""
        registers: list[Any] = [None] * self.registers
        for i, value in enumerate((*q, *v, *u)):
            registers[self.symbols + i] = value
        for i, value in zip(self.lumped, lumped, strict=True):
            registers[i] = value
        _run(self.motion, registers, sin, cos)
        return [registers[a.index] if isinstance(a, Node) else a for a in self.outputs]


_ARITHMETIC = {"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv}


def _run(
    instructions: Sequence[Instruction], registers: list[Any], sin: Callable | None = None, cos: Callable | None = None
) -> None:
    operations: dict[str, Any] = _ARITHMETIC | {"sin": sin, "cos": cos}
    for target, operation, operands in instructions:
        values = [registers[a.index] if isinstance(a, Node) else a for a in operands]
        registers[target] = operations[operation](*values)


def emit(equations: Equations, symbols: int) -> Program:
    """The program of the accelerations."""
    writer = _Writer(equations, symbols)
    mass = [[writer.polynomial(p) for p in row] for row in equations.mass]
    forces = [writer.force(i) for i in range(writer.nv)]
    return writer.program([writer.value(a) for a in writer.solve(mass, forces)])


class _Writer:
    """Writes instructions, each expression once."""

    def __init__(self, equations: Equations, symbols: int):
        self.equations = equations
        self.symbols = symbols
        self.nv, self.nu = len(equations.angles), len(equations.motors[0])
        self.nodes = [Node(i, i >= symbols) for i in range(symbols + 2 * self.nv + self.nu)]
        self.instructions: list[Instruction] = []
        self.known: dict[tuple, Node] = {}
        self.negated: dict[Node, Node] = {}
        states = self.nodes[symbols:]
        self.q, self.v, self.u = states[: self.nv], states[self.nv : 2 * self.nv], states[2 * self.nv :]

    def program(self, outputs: Sequence[Number]) -> Program:
        motion = tuple(i for i in self.instructions if self.nodes[i.target].moving)
        used = {a for i in motion for a in i.operands} | set(outputs)
        return Program(
            symbols=self.symbols,
            registers=len(self.nodes),
            lumping=tuple(i for i in self.instructions if not self.nodes[i.target].moving),
            lumped=tuple(sorted(a.index for a in used if isinstance(a, Node) and not a.moving)),
            motion=motion,
            outputs=tuple(outputs),
        )

    def force(self, i: int) -> Sum:
        """All that accelerates the i-th joint."""
        e = self.equations
        stiffness, rest = e.springs[i]
        pulls = [self.times(self.polynomial(motor), {u: 1.0}) for motor, u in zip(e.motors[i], self.u, strict=True)]
        drags = [
            self.times(self.polynomial(e.damping[i]), {self.v[i]: 1.0}),
            self.times(self.polynomial(stiffness), {self.q[i]: 1.0, None: -rest}),
            self.polynomial(e.slopes[i]),
            *(self.times(self.polynomial(p), self.square(j, k)) for (j, k), p in e.christoffel[i].items()),
        ]
        return self.minus(self.plus(*pulls), *drags)

    def square(self, j: int, k: int) -> Sum:
        """v_j v_k."""
        return self.times({self.v[j]: 1.0}, {self.v[k]: 1.0})

    def solve(self, mass: list[list[Sum]], forces: list[Sum]) -> list[Sum]:
        """a of M a = f by M = L' D L from the last row; zeros stay zeros on a tree (Featherstone 2008, section 6.5).

        Row k is divided by its diagonal before it is eliminated: where the diagonal is of the design alone, that costs
        nothing at a state.
        """
        n = len(forces)
        mass, forces = [list(row) for row in mass], list(forces)
        unit = [[ZERO] * n for _ in range(n)]
        for k in reversed(range(n)):
            forces[k] = self.whole(self.over(forces[k], mass[k][k]))
            unit[k][:k] = [self.over(mass[k][i], mass[k][k]) for i in range(k)]
            for i in range(k):
                forces[i] = self.minus(forces[i], self.times(mass[k][i], forces[k]))
                for j in range(i + 1):
                    mass[i][j] = self.minus(mass[i][j], self.times(mass[k][i], unit[k][j]))
        accelerations: list[Sum] = []
        for k in range(n):
            pulled = (self.times(factor, a) for factor, a in zip(unit[k], accelerations, strict=False))
            accelerations.append(self.minus(forces[k], *pulled))
        return accelerations

    def polynomial(self, p: Laurent) -> Sum:
        """Its value: harmonics of the angles times powers of the slides, with coefficients of the design."""
        nv, angles = self.nv, self.equations.angles
        terms = []
        for exponents, c in p.terms.items():
            wave = tuple(e if angle else 0 for e, angle in zip(exponents, angles, strict=False))
            leading = next((k for k in wave if k), 0)
            if leading < 0:
                continue  # the conjugate term says the same
            share = 2.0 if leading else 1.0
            cosine, sine = self.harmonic(wave)
            value = self.plus(self.times({None: share * c.real}, cosine), self.times({None: -share * c.imag}, sine))
            for node, power in zip((*self.q, *self.nodes), (*self._slides(exponents), *exponents[nv:]), strict=False):
                for _ in range(power):
                    value = self.times(value, {node: 1.0} if node.moving else {None: node})
            terms.append(value)
        return self.plus(*terms)

    def _slides(self, exponents: Sequence[int]) -> list[int]:
        return [0 if angle else e for e, angle in zip(exponents, self.equations.angles, strict=False)]

    def harmonic(self, wave: Sequence[int]) -> tuple[Sum, Sum]:
        """Cosine and sine of wave . q, by the addition theorem from those of the single angles."""
        if not any(wave):
            return ONE, ZERO
        last = max(i for i, k in enumerate(wave) if k)
        sign = 1 if wave[last] > 0 else -1
        rest = tuple(k - sign * (i == last) for i, k in enumerate(wave))
        c1: Sum = {self.write("cos", self.q[last]): 1.0}
        s1: Sum = {self.write("sin", self.q[last]): float(sign)}
        c0, s0 = self.harmonic(rest)
        cosine = self.minus(self.times(c0, c1), self.times(s0, s1))
        sine = self.plus(self.times(s0, c1), self.times(c0, s1))
        return self.whole(cosine), self.whole(sine)

    def plus(self, *sums: Sum) -> Sum:
        total: dict[Node | None, Number] = {}
        for terms in sums:
            for node, coefficient in terms.items():
                total[node] = self.apply("+", total.get(node, 0.0), coefficient)
        return {node: coefficient for node, coefficient in total.items() if coefficient != 0.0}

    def minus(self, first: Sum, *others: Sum) -> Sum:
        return self.plus(first, *({node: self.apply("*", -1.0, c) for node, c in terms.items()} for terms in others))

    def times(self, a: Sum, b: Sum) -> Sum:
        """A number of the design is distributed over a sum; sums of more terms are written down first."""
        if not a or not b:
            return ZERO
        for one, other in ((a, b), (b, a)):
            if one.keys() == {None}:
                return {node: self.apply("*", one[None], c) for node, c in other.items()}
        ((x, p),), ((y, q),) = self.whole(a).items(), self.whole(b).items()
        pair = [node for node in (x, y) if node]
        node = self.write("*", *sorted(pair, key=lambda node: node.index)) if len(pair) == 2 else pair[0]
        return {node: self.apply("*", p, q)}

    def over(self, a: Sum, b: Sum) -> Sum:
        """Divided at once: XLA for CPUs makes slower programs of reciprocals."""
        ((divisor, coefficient),) = self.whole(b).items()
        if divisor is None:
            return {node: self.apply("/", c, coefficient) for node, c in a.items()}
        if not a:
            return ZERO
        ((node, c),) = self.whole(a).items()
        return {self.write("/", node or 1.0, divisor): self.apply("/", c, coefficient)}

    def whole(self, a: Sum) -> Sum:
        """The same value with one term, where there is any: terms of one coefficient, but for the sign, first."""
        if len(a) <= 1:
            return a
        groups: dict[Number, list[tuple[float, Number]]] = {}
        for node, coefficient in a.items():
            sign, size = self.signed(coefficient)
            group, term = (size, node) if node else (1.0, size)
            groups.setdefault(group, []).append((sign, term))
        parts = [self._total(terms, size) for size, terms in groups.items()]
        sign, value = self._total(parts, 1.0)
        return {value: sign} if isinstance(value, Node) else {None: sign * value}

    def _total(self, terms: list[tuple[float, Number]], size: Number) -> tuple[float, Number]:
        """Sign and rest of size * sum of signed terms, the positive ones first."""
        (sign, value), *others = sorted(terms, key=lambda term: -term[0])
        for other, term in others:
            value = self.apply("+" if other == sign else "-", value, term)
        return sign, self.apply("*", size, value)

    def value(self, a: Sum) -> Number:
        """The value in one register, or a number."""
        if not a:
            return 0.0
        ((node, coefficient),) = self.whole(a).items()
        return self.apply("*", coefficient, node) if node else coefficient

    def signed(self, a: Number) -> tuple[float, Number]:
        """Sign and size."""
        if isinstance(a, float):
            return (-1.0, -a) if a < 0 else (1.0, a)
        return (-1.0, self.negated[a]) if a in self.negated else (1.0, a)

    def apply(self, operation: str, a: Number, b: Number) -> Number:
        """a operation b, known numbers folded."""
        if isinstance(a, float) and isinstance(b, float):
            return {"+": a + b, "-": a - b, "*": a * b}[operation] if operation != "/" else a / b
        if operation in "*/":
            (p, a), (q, b) = self.signed(a), self.signed(b)
            return self._with_sign(p * q, self._scaled(operation, a, b))
        (p, a), (q, b) = self.signed(a), self.signed(b)
        if operation == "-":
            q = -q
        if a == 0.0 or b == 0.0:
            return self._with_sign(p if b == 0.0 else q, a if b == 0.0 else b)
        if p == q:
            return self._with_sign(p, self.write("+", *self._ordered(a, b)))
        return self.write("-", a, b) if p > 0 else self.write("-", b, a)

    def _scaled(self, operation: str, a: Number, b: Number) -> Number:
        if a == 0.0 or b == 1.0:
            return a
        if operation == "/":
            return self.write("/", a, b)
        if b == 0.0 or a == 1.0:
            return b
        return self.write("*", *self._ordered(a, b))

    def _ordered(self, a: Number, b: Number) -> tuple[Number, Number]:
        if isinstance(b, Node) and not (isinstance(a, Node) and a.index <= b.index):
            return b, a
        return a, b

    def _with_sign(self, sign: float, a: Number) -> Number:
        if sign > 0 or a == 0.0:
            return a
        if not isinstance(a, Node):
            return -a
        negative = self.write("*", a, -1.0)
        self.negated[negative] = a
        return negative

    def write(self, operation: str, *operands: Number) -> Node:
        """The register of an expression, written once."""
        key = (operation, *operands)
        if key not in self.known:
            moving = any(isinstance(a, Node) and a.moving for a in operands)
            node = self.known[key] = Node(len(self.nodes), moving)
            self.nodes.append(node)
            self.instructions.append(Instruction(node.index, operation, operands))
        return self.known[key]
