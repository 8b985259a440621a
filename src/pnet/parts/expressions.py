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

_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
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
    value = _evaluate(expression, names, parameters)
    return np.broadcast_to(np.asarray(value, float) / 1000, parameters.shape[:-1])


def holds(condition: str, names: Sequence[str], parameters: Points) -> NDArray[np.bool_]:
    """Whether a comparison of two lengths holds; arguments as in `length`, result (...)."""
    value = np.asarray(_evaluate(condition, names, parameters))
    if value.dtype != np.bool_:
        raise ValueError(f"{condition!r} compares nothing; write for example 'd > r'")
    return np.broadcast_to(value, parameters.shape[:-1])


def check_expression(expression: Expression, names: Sequence[str]) -> None:
    """Raise ValueError where an expression cannot be evaluated."""
    _evaluate(expression, names, np.ones(len(names)))


def _evaluate(expression: Expression, names: Sequence[str], parameters: Points) -> Any:
    values = {name: 1000 * parameters[..., i] for i, name in enumerate(names)}
    return _value(_parse(str(expression)), values, str(expression))


@lru_cache(maxsize=1024)
def _parse(text: str) -> ast.expr:
    try:
        return ast.parse(text, mode="eval").body
    except SyntaxError as fault:
        raise ValueError(f"{text!r} is no expression; write for example '0.5 * h + 2'") from fault


def _value(node: ast.expr, values: dict[str, Any], text: str) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return number
        case ast.Name(id=name) if name in values:
            return values[name]
        case ast.Name(id=name):
            raise ValueError(f"{text!r}: {name!r} is not one of the parameters {list(values)}")
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, values, text)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            return _BINARY[type(op)](_value(left, values, text), _value(right, values, text))
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _BINARY:
            return _BINARY[type(op)](_value(left, values, text), _value(right, values, text))
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]) if name in _FUNCTIONS:
            return _call(name, [_value(argument, values, text) for argument in arguments], text)
    raise ValueError(
        f"{text!r}: only numbers, parameters, + - * /, < > and {', '.join(_FUNCTIONS)} can be used"
    )


def _call(name: str, arguments: list[Any], text: str) -> Any:
    wanted = 2 if name in ("min", "max") else 1
    if len(arguments) != wanted:
        raise ValueError(f"{text!r}: {name} takes {wanted} value{'s' if wanted > 1 else ''}")
    return _FUNCTIONS[name](*arguments)
