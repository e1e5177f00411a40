"""Numbers written as arithmetic, such as `2*pi/3`: names, numbers, + - * / ** and parentheses, nothing else."""

import ast
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


def arithmetic(text: str, names: Mapping[str, float]) -> float:
    """The value of `text` over `names` and pi.

    Raises:
        ValueError: it is no arithmetic, names something else, or its value is no finite number.
    """
    try:
        if len(text) > LONGEST:
            raise ValueError(f"has {len(text)} characters, at most {LONGEST} are read")
        value = _value(ast.parse(text.strip(), mode="eval").body, {"pi": math.pi, **names})
    except (SyntaxError, TypeError):
        raise ValueError(f"is no arithmetic: {_ALLOWED}") from None
    except (ZeroDivisionError, OverflowError):
        value = math.nan
    if isinstance(value, complex) or not math.isfinite(value):
        raise ValueError("has no finite value")
    return value


_ALLOWED = "must be a number, or numbers and names with + - * / ** and parentheses"


def _value(node: ast.expr, names: Mapping[str, float]) -> Any:
    match node:
        case ast.Constant(int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(name):
            if name not in names:
                raise ValueError(f"names {name}; there is {', '.join(names)}")
            return names[name]
        case ast.BinOp(left, operation, right) if type(operation) in _OPERATIONS:
            return _OPERATIONS[type(operation)](_value(left, names), _value(right, names))
        case ast.UnaryOp(operation, operand) if type(operation) in _OPERATIONS:
            return _OPERATIONS[type(operation)](_value(operand, names))
    raise ValueError(f"is no arithmetic: {_ALLOWED}")
