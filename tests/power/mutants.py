"""Creates mutants: copies of a module with one small change, swap or omission.

An index or an integer up to `LARGE` changes by 1, and a larger number by a quarter. A float is
multiplied by 1.25 and by 0.8.

Strings are not changed, because they are messages for people. Annotations, `zip(strict=...)` and
`frozen=...` are not changed, because they do not affect correct programs.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

COMPARE: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
}
ARITHMETIC: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
}
COMMUTATIVE = (ast.Add, ast.Mult, ast.BitXor, ast.BitAnd, ast.BitOr)
LARGE = 20
"""A whole number above this is changed by a quarter unless it is an index."""

NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "sin": "cos", "cos": "sin"}
# Functions whose arguments, or terms of a difference, have no order.
SYMMETRIC = "min", "max", "np.minimum", "np.maximum", "math.hypot", "np.hypot", "isinstance"
SIZES = "abs", "np.abs"
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
MEMBERS = {"Mode": ["SHUTDOWN", "FAULT", "STOPPED", "INACTIVE", "WAITING", "DRIVING", "READY"]}


class Mutant(NamedTuple):
    """A module with one small fault.

    Attributes:
        path: The module, relative to the project.
        line: The line of the fault.
        statement: The first line of the statement with the fault, or 0 outside of functions.
        key: The description that `equivalent.py` uses. It has no line number.
        text: Returns the source of the module with the fault in it.
    """

    path: str
    line: int
    statement: int
    key: str
    text: Callable[[], str]


def variants(node: ast.AST, parent: ast.AST, field: str) -> Iterator[ast.AST]:
    """Return the syntax nodes that a mutant may have in place of this node."""

    def made(kind: type, **changed: Any) -> Any:
        parts = {name: getattr(node, name) for name in node._fields} | changed
        return kind(**parts)

    match node:
        case ast.Compare(ops=[op]):
            yield from (made(ast.Compare, ops=[other()]) for other in COMPARE.get(type(op), ()))
        case ast.BinOp(op=op) | ast.AugAssign(op=op):
            if type(op) in ARITHMETIC:
                yield made(type(node), op=ARITHMETIC[type(op)]())
            sized = isinstance(parent, ast.Call) and ast.unparse(parent.func) in SIZES
            if isinstance(node, ast.BinOp) and not isinstance(op, COMMUTATIVE) and not sized:
                yield made(ast.BinOp, left=node.right, right=node.left)
        case ast.BoolOp(op=op, values=values):
            yield made(ast.BoolOp, op=ast.Or() if isinstance(op, ast.And) else ast.And())
            for value in values:
                rest = [other for other in values if other is not value]
                yield rest[0] if len(rest) == 1 else made(ast.BoolOp, values=rest)
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            # One more or less of a large size says nothing about a test, but of an index it does.
            index = isinstance(parent, ast.Slice | ast.Subscript)
            change = value // 4 if value > LARGE and not index else 1
            yield from (ast.Constant(value + change), ast.Constant(value - change))
        case ast.Constant(value=float(value)):
            yield from (ast.Constant(value * 1.25 or 1.0), ast.Constant(value * 0.8 or -1.0))
        case ast.Constant(value=bytes(value)) if value:
            yield ast.Constant(value[1:])
        case ast.IfExp(body=body, orelse=orelse):
            yield from (body, orelse)
        case ast.Attribute(value=ast.Name(id=name), attr=attr) if attr in MEMBERS.get(name, ()):
            following = (MEMBERS[name] * 2)[MEMBERS[name].index(attr) + 1]
            yield made(ast.Attribute, attr=following)
        case ast.Call(func=func, args=args):
            match func:
                case ast.Name(id=name) if name in NAMES:
                    yield made(ast.Call, func=ast.Name(NAMES[name]))
                case ast.Name(id="abs"):
                    yield args[0]
                case ast.Attribute(attr=name) if name in NAMES:
                    yield made(ast.Call, func=ast.Attribute(func.value, NAMES[name]))
            if len(args) > 1 and ast.unparse(func) not in SYMMETRIC:
                yield made(ast.Call, args=[args[1], args[0], *args[2:]])
        case ast.Return(value=value) if value and not isinstance(value, ast.Constant):
            yield ast.Return(ast.Constant(None))
    if field in ("test", "ifs") and not isinstance(node, ast.Compare | ast.BoolOp | ast.UnaryOp):
        yield ast.UnaryOp(ast.Not(), cast(ast.expr, node))
    match node:
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise() | ast.Delete():
            yield ast.Pass()
        case ast.If(orelse=[]) | ast.Return(value=ast.Constant() | None):
            yield ast.Pass()
        case ast.Assign(targets=targets) if not isinstance(parent, ast.Module | ast.ClassDef):
            # A local name without its assignment raises an error, which every test notices.
            if not any(
                isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
                for target in targets
                for n in ast.walk(target)
            ):
                yield ast.Pass()


def places(
    node: ast.AST, scope: str = "", statement: int = 0, part: ast.AST | None = None
) -> Iterator[tuple[ast.AST, str, ast.AST, str, int, ast.AST]]:
    """Yield every place in the syntax tree where a mutant may differ.

    Each item is the parent node, its field, the node, its scope, the first line of its statement,
    and the part of the module that contains it: a function, or a statement outside of functions.

    Args:
        node: The root of the searched tree.
        scope: The names of the classes and functions around it.
        statement: The first line of the statement around it, or 0 outside of functions.
        part: The part of the module around it, if any.
    """
    function = isinstance(node, FUNCTION)
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        scope += f".{node.name}" if scope else node.name
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "bases"):
            continue
        within = statement > 0 or (function and field == "body")
        for child in value if isinstance(value, list) else [value]:
            match child:
                case ast.JoinedStr() | ast.keyword(arg="strict" | "frozen"):
                    continue
                case ast.AST():
                    starts = within and isinstance(child, ast.stmt)
                    line: int = getattr(child, "lineno", 0) if starts else statement
                    whole = part
                    if not part and isinstance(child, ast.stmt) and type(child) is not ast.ClassDef:
                        whole = child
                    if whole:
                        yield node, field, child, scope, line, whole
                    yield from places(child, scope, line, whole)


def put(parent: ast.AST, field: str, old: ast.AST, new: ast.AST) -> None:
    """Replace the child `old` of the syntax node `parent` by `new`."""
    value = getattr(parent, field)
    if isinstance(value, list):
        value[next(i for i, child in enumerate(value) if child is old)] = new
    else:
        setattr(parent, field, new)


def mutants(root: Path, path: str) -> Iterator[Mutant]:
    """Yield all mutants of one module."""
    tree = ast.parse((root / path).read_text(encoding="utf-8"))
    whole, original = None, ""
    for parent, field, node, scope, statement, part in list(places(tree)):
        for variant in variants(node, parent, field):
            if part is not whole:
                whole, original = part, ast.unparse(part)
            new = deepcopy(variant)
            put(parent, field, node, new)
            text = ast.unparse(new if part is node else part)
            put(parent, field, new, node)
            if text != original:
                line: int = getattr(node, "lineno", getattr(parent, "lineno", 0))
                key = f"{path} {scope}: {change(original, text)}"
                make = partial(replaced, tree, parent, field, node, new)
                yield Mutant(path, line, statement, key, make)


def replaced(tree: ast.AST, parent: ast.AST, field: str, node: ast.AST, new: ast.AST) -> str:
    """Return the source of the tree with the node `new` in place of `node`."""
    put(parent, field, node, new)
    text = ast.unparse(tree)
    put(parent, field, new, node)
    return text


def change(before: str, after: str) -> str:
    """Return the difference of two sources in one line, with some text around it."""
    old, new = before.splitlines(), after.splitlines()
    while old and new and old[0] == new[0]:
        del old[0], new[0]
    while old and new and old[-1] == new[-1]:
        del old[-1], new[-1]
    old_text, new_text = (" ".join(line.strip() for line in lines) for lines in (old, new))
    start = common(old_text, new_text)
    end = common(old_text[start:][::-1], new_text[start:][::-1])
    left = max(0, start - 30) if start > 60 else 0
    return " -> ".join(
        repr(text[left : len(text) - end + 30 if end > 60 else None])
        for text in (old_text, new_text)
    )


def common(first: str, other: str) -> int:
    """Return the length of the common prefix of two strings."""
    pairs = enumerate(zip(first, other, strict=False))
    return next((i for i, (a, b) in pairs if a != b), min(len(first), len(other)))
