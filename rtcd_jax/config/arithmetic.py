"""Numbers written as arithmetic, such as `2*pi/3`: names, numbers, + - * / **, parentheses and a few functions."""

import ast
import functools
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

LONGEST = 200
"""Characters: deeper nesting than that is no number."""

_OPERATIONS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip

FUNCTIONS = ("sin", "cos", "tan", "asin", "acos", "atan", "sqrt")

_ALLOWED = f"must be a number, or numbers and names with + - * / **, parentheses and {', '.join(FUNCTIONS)}"


def arithmetic(text: str, names: Mapping[str, float]) -> float:
    """The value of `text` over `names` and pi.

    Raises:
        ValueError: it is no arithmetic, names something else, or its value is no finite number.
    """
    for name in names_of(text):
        if name not in names:
            raise ValueError(f"names {name}; there is {', '.join(('pi', *names))}")
    try:
        value = evaluate(text, names)
    except TypeError:
        raise ValueError(f"is no arithmetic: {_ALLOWED}") from None
    except (ZeroDivisionError, OverflowError, ValueError):
        value = math.nan
    if isinstance(value, complex) or not math.isfinite(value):
        raise ValueError("has no finite value")
    return value


def names_of(text: str) -> tuple[str, ...]:
    """The names in `text` but pi, in the order of their first appearance.

    Raises:
        ValueError: it is no arithmetic.
    """
    return _names(_parsed(text))


def calls_functions(text: str) -> bool:
    """Whether `text`, which is arithmetic, is more than a rational function of its names."""
    return any(isinstance(node, ast.Call) for node in ast.walk(_parsed(text)))


def evaluate(text: str, names: Mapping[str, Any]) -> Any:
    """The value of `text`, that of an array as well, over `names`, which has all that `text` names."""
    return _value(_parsed(text), {"pi": math.pi, **names})


@functools.cache
def _parsed(text: str) -> ast.expr:
    if len(text) > LONGEST:
        raise ValueError(f"has {len(text)} characters, at most {LONGEST} are read")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except SyntaxError:
        raise ValueError(f"is no arithmetic: {_ALLOWED}") from None
    _names(tree)
    return tree


def _names(node: ast.expr) -> tuple[str, ...]:
    match node:
        case ast.Constant(int() | float() as value) if not isinstance(value, bool):
            return ()
        case ast.Name(name):
            return () if name == "pi" else (name,)
        case ast.BinOp(left, operation, right) if type(operation) in _OPERATIONS:
            return tuple(dict.fromkeys((*_names(left), *_names(right))))
        case ast.UnaryOp(operation, operand) if type(operation) in _OPERATIONS:
            return _names(operand)
        case ast.Call(ast.Name(name), [argument], []) if name in FUNCTIONS:
            return _names(argument)
    raise ValueError(f"is no arithmetic: {_ALLOWED}")


def _value(node: ast.expr, names: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(int() | float() as value):
            return float(value)
        case ast.Name(name):
            return names[name]
        case ast.BinOp(left, ast.Pow(), ast.Constant(int() as power)):
            return _value(left, names) ** power  # a product, where a float would be a logarithm
        case ast.BinOp(left, operation, right):
            return _OPERATIONS[type(operation)](_value(left, names), _value(right, names))
        case ast.UnaryOp(operation, operand):
            return _OPERATIONS[type(operation)](_value(operand, names))
        case ast.Call(ast.Name(name), [argument], []):
            value = _value(argument, names)
            library = value.__array_namespace__() if hasattr(value, "__array_namespace__") else math
            return getattr(library, name)(value)
    raise TypeError(node)
