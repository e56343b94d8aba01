"""Places where a module can be broken by one small change, and the broken text."""

import ast
import warnings
from collections.abc import Iterator
from typing import NamedTuple

OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
COMPARISONS = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
OPPOSITES = {
    "min": "max",
    "minimum": "maximum",
    "argmin": "argmax",
    "nanmin": "nanmax",
    "any": "all",
    "sin": "cos",
    "mean": "sum",
}
OPPOSITES |= {there: here for here, there in OPPOSITES.items()}
REORDERED = ("transpose", "swapaxes")


class Mutant(NamedTuple):
    """
    One change of one module.

    Attributes
    ----------
    file : str
        The module, relative to the root.
    line : int
        Where the change begins.
    lines : tuple of int
        First and last line of the statement or, of one with others inside, of the
        expression.
    in_function : bool
        Whether the line runs when a function is called, not at import.
    before, after : str
        What stands there, and what stands there in its place.
    text : str
        The module with the change.
    """

    file: str
    line: int
    lines: tuple
    in_function: bool
    before: str
    after: str
    text: str


def mutants(file: str, text: str) -> Iterator[Mutant]:
    """Yield each change of a module, one at a time."""
    lines = text.encode().splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    content = b"".join(lines)
    tree = ast.parse(text)
    places = dict(_places(tree, False))
    for node in _expressions(tree):
        for changed in _changes(node):
            start = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            before, after = content[start:end].decode(), ast.unparse(changed)
            broken = content[:start] + f"({after})".encode() + content[end:]
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", SyntaxWarning)
                    compile(broken, file, "exec")
            except SyntaxError:  # a place where no parentheses may stand
                continue
            before = " ".join(before.split())
            place = (node.lineno, *places[id(node)])
            yield Mutant(file, *place, before, after, broken.decode())


def _places(node: ast.AST, in_function: bool, lines: tuple = ()) -> Iterator[tuple]:
    """Yield the lines of each expression, as of a mutant, and if a call runs them."""
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST):
                continue
            inside = in_function or (
                isinstance(node, ast.FunctionDef | ast.Lambda) and name == "body"
            )
            own = lines
            if isinstance(child, ast.stmt):
                whole = not hasattr(child, "body")
                own = (child.lineno, child.end_lineno) if whole else ()
            if isinstance(child, ast.expr):
                place = own or (child.lineno, child.end_lineno)
                yield id(child), (place, inside)
            yield from _places(child, inside, own)


def _expressions(tree: ast.Module) -> Iterator[ast.expr]:
    """Yield the expressions that compute something: no types, no messages.

    Neither ``strict`` of `zip` nor options of decorators change a result.
    """
    left_out = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise | ast.JoinedStr | ast.Assert):
            left_out.append(node)
        elif isinstance(node, ast.AnnAssign | ast.arg) and node.annotation:
            left_out.append(node.annotation)
        elif isinstance(node, ast.ClassDef):
            left_out += node.decorator_list
        elif isinstance(node, ast.keyword) and node.arg == "strict":
            left_out.append(node.value)
        elif isinstance(node, ast.FunctionDef):
            left_out += [*node.decorator_list, *filter(None, [node.returns])]
        elif isinstance(node, ast.Call) and "warn" in ast.unparse(node.func):
            left_out.append(node)
    hidden = {id(inner) for node in left_out for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.expr) and id(node) not in hidden:
            yield node


def _changes(node: ast.expr) -> Iterator[ast.expr]:
    """Yield what may stand in the place of an expression."""
    match node:
        case ast.BinOp(left, operator, right):
            if not (_is_text(left) or _is_text(right)):
                if type(operator) in OPERATORS:
                    yield ast.BinOp(left, OPERATORS[type(operator)](), right)
                    yield left
                if isinstance(operator, ast.Add | ast.Mult):
                    yield right
        case ast.Compare(left, [operator], [right]):
            for other in COMPARISONS.get(type(operator), ()):
                yield ast.Compare(left, [other()], [right])
        case ast.BoolOp(operator, values):
            other = ast.Or() if isinstance(operator, ast.And) else ast.And()
            yield ast.BoolOp(other, values)
        case ast.UnaryOp(ast.USub() | ast.Not(), operand):
            yield operand
        case ast.Constant(bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(int() as value):
            yield ast.Constant(value + 1)
            if value > 0:
                yield ast.Constant(value - 1)
        case ast.Constant(float() as value):
            yield ast.Constant(2 * value if value else 1.0)
        case ast.Attribute(value, "T" | "mT"):
            yield value
        case ast.Call(ast.Attribute(value, name), arguments, keywords):
            if name in REORDERED:
                yield value
            elif name in OPPOSITES:
                opposite = ast.Attribute(value, OPPOSITES[name])
                yield ast.Call(opposite, arguments, keywords)
        case ast.Call(ast.Name(name), arguments, keywords) if name in OPPOSITES:
            if name != "sum":
                yield ast.Call(ast.Name(OPPOSITES[name]), arguments, keywords)


def _is_text(node: ast.expr) -> bool:
    """Return whether an expression is a text as it stands there."""
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    )
