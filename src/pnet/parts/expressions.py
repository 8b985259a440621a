"""Arithmetic in part declarations: `0.3 * h + 2`, `d * sqrt(3) / 2 > r`; lengths in millimetres.

Parsed by Python's own grammar and evaluated by this file alone: names of parameters, numbers, + − * /,
a few functions and one comparison. Nothing else can be written, so a declaration stays data.
"""

import ast
import operator
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Expression = str | float | int

MOST = 200  # characters of an expression
_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_COMPARISONS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sqrt": np.sqrt,
    "min": np.minimum,
    "max": np.maximum,
    "sin": lambda degrees: np.sin(np.radians(degrees)),
    "cos": lambda degrees: np.cos(np.radians(degrees)),
    "tan": lambda degrees: np.tan(np.radians(degrees)),
}


def length(expression: Expression, names: Sequence[str], parameters: Points) -> Points:
    """Value of a length.

    Args:
        expression: text or a number, millimetres. names: (k) of the parameters.
        parameters: (..., k) metres.
    Returns:
        (...) metres.
    Raises:
        ValueError: names the expression and what is wrong with it.
    """
    value = np.asarray(_evaluate(_parse(str(expression)), names, parameters, str(expression)), float)
    if not np.isfinite(value).all():
        raise ValueError(
            f"{expression!r} has no finite value for {', '.join(names)} = {1000 * parameters} mm"
        )
    return np.broadcast_to(value / 1000, parameters.shape[:-1])


def holds(condition: str, names: Sequence[str], parameters: Points) -> NDArray[np.bool_]:
    """Whether a comparison of two lengths holds; arguments as in `length`, result (...)."""
    left, compare, right = _sides(condition)
    values = (_evaluate(side, names, parameters, condition) for side in (left, right))
    return np.broadcast_to(np.asarray(compare(*values)), parameters.shape[:-1])


def check_expression(expression: Expression, names: Sequence[str]) -> None:
    """Raise ValueError where an expression is none, or names something unknown."""
    _evaluate(_parse(str(expression)), names, np.linspace(0.01, 0.02, len(names)), str(expression))


def check_condition(condition: str, names: Sequence[str]) -> None:
    """Raise ValueError where a condition is no comparison, or names something unknown."""
    holds(condition, names, np.linspace(0.01, 0.02, len(names)))


def _evaluate(node: ast.expr, names: Sequence[str], parameters: Points, text: str) -> Any:
    values = {name: 1000 * parameters[..., i] for i, name in enumerate(names)}
    with np.errstate(all="ignore"):
        try:
            return _value(node, values, text)
        except ArithmeticError as fault:  # of plain numbers, such as 1 / 0
            raise ValueError(f"{text!r} has no finite value ({fault})") from fault


@lru_cache(maxsize=1024)
def _parse(text: str) -> ast.expr:
    if len(text) > MOST:
        raise ValueError(f"{text[:20]!r}… has {len(text)} characters, at most {MOST} are read")
    try:
        return ast.parse(text.strip(), mode="eval").body
    except SyntaxError as fault:
        raise ValueError(f"{text!r} is no expression; write for example '0.5 * h + 2'") from fault


def _sides(condition: str) -> tuple[ast.expr, Callable[[Any, Any], Any], ast.expr]:
    match _parse(condition):
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARISONS:
            return left, _COMPARISONS[type(op)], right
    raise ValueError(f"{condition!r} compares nothing; write for example 'd > r'")


def _value(node: ast.expr, values: dict[str, Any], text: str) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return np.float64(number)
        case ast.Name(id=name) if name in values:
            return values[name]
        case ast.Name(id=name):
            raise ValueError(f"{text!r}: {name!r} is not one of the parameters {list(values)}")
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, values, text)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            return _BINARY[type(op)](_value(left, values, text), _value(right, values, text))
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in _FUNCTIONS:
            return _call(name, [_value(argument, values, text) for argument in arguments], text)
    raise ValueError(
        f"{text!r}: a length is made of numbers, parameters, + - * / and {', '.join(_FUNCTIONS)}"
    )


def _call(name: str, arguments: list[Any], text: str) -> Any:
    wanted = 2 if name in ("min", "max") else 1
    if len(arguments) != wanted:
        raise ValueError(f"{text!r}: {name} takes {wanted} value{'s' if wanted > 1 else ''}")
    return _FUNCTIONS[name](*arguments)
