"""Faster start-up: what Taichi 1.7.4 does in Python before it can even look a kernel up in its cache.

Every process translates every kernel from Python again, and a `ti.func` once more for each call of it. Most of that
time goes where it has no influence on what comes out, and is spared here:

- Taichi lays out the source of every node of a syntax tree with a row of carets below it, in case there is an error.
  Here a position is the file, the line of the statement and its text, and expressions share their statement's.
- It looks for the source of a function, tokenizes and parses it at every call. Here that happens once; the tree is
  used again when the call for which it was parsed is done.
- It asks NumPy anew for the range of integers at every constant.
"""

from __future__ import annotations

import ast
import functools
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import taichi as ti
from taichi.lang import (
    expr,
    kernel_impl,
    matrix_ops,  # noqa: F401  the first kernel would import it, and not quickly
)
from taichi.lang.ast.ast_transformer import ASTTransformer
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext, Builder

_KNOWN = (1, 7, 4)  # everything replaced below is private: another Taichi keeps its own

_build, _transform = Builder.__call__, kernel_impl.transform_tree
_BUILDERS: dict[type[ast.expr], Callable[..., Any]] = {
    kind: getattr(ASTTransformer, f"build_{kind.__name__}")
    for kind in ast.expr.__subclasses__()
    if hasattr(ASTTransformer, f"build_{kind.__name__}")
}


def speed_up_translation() -> None:
    """Put what is cheaper into Taichi's place, for the rest of the process."""
    if ti.__version__ == _KNOWN and ASTTransformer.__call__ is not _built:
        ASTTransformerContext.get_pos_info = _position
        ASTTransformer.__call__ = _built
        kernel_impl._get_tree_and_ctx = _tree_and_context
        kernel_impl.transform_tree = _transformed
        expr._check_in_range = functools.cache(expr._check_in_range)
        expr._clamp_unsigned_to_range = functools.cache(expr._clamp_unsigned_to_range)


@dataclass(frozen=True)
class _Source:
    """The text of a kernel or of a function that kernels call."""

    file: str
    first_line: int  # in the file, from 1
    lines: list[str]
    unused: list[ast.Module]  # trees of it that are in no call's hands

    def tree(self) -> ast.Module:
        """A tree for one call. Not simply the same for all, as a function may come up within its own call."""
        if self.unused:
            return self.unused.pop()
        tree = ast.parse(textwrap.dedent("\n".join(self.lines)))
        tree.body[0].decorator_list = []  # type: ignore[attr-defined]
        return tree


@functools.cache
def _source(function: Callable[..., Any]) -> _Source:
    lines, first_line = kernel_impl.getsourcelines(function)
    return _Source(
        kernel_impl.getsourcefile(function), first_line, [line.rstrip().expandtabs(4) for line in lines], unused=[]
    )


def _position(context: ASTTransformerContext, node: ast.stmt | ast.expr) -> str:
    line = node.lineno + context.lineno_offset
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n{context.src[node.lineno - 1]}\n'


def _tree_and_context(
    function: Any, excluded_parameters: Any = (), is_kernel: bool = True, args: Any = None, **others: Any
) -> tuple[ast.Module, ASTTransformerContext]:
    """What `transform_tree` needs for a call; a kernel's template arguments count as its globals."""
    source, variables = _source(function.func), kernel_impl._get_global_vars(function.func)
    if is_kernel or others.get("is_real_function"):
        variables |= {function.arguments[i].name: args[i] for i in function.template_slot_locations}
    return source.tree(), ASTTransformerContext(
        excluded_parameters=excluded_parameters,
        is_kernel=is_kernel,
        func=function,
        global_vars=variables,
        argument_data=args,
        src=source.lines,
        start_lineno=source.first_line,
        file=source.file,
        **others,
    )


def _transformed(tree: ast.Module, context: ASTTransformerContext) -> Any:
    """`transform_tree`, after which the tree can be used again; a kernel's cannot, as it loses its parameters."""
    result = _transform(tree, context)
    if not (context.is_kernel or context.is_real_function):
        _source(context.func.func).unused.append(tree)
    return result


def _built(transformer: ASTTransformer, context: ASTTransformerContext, node: Any) -> Any:
    """Walk a node: an expression without the guard that Taichi puts round each; its statement has one."""
    kind = type(node)
    if kind is ast.Name:
        for scope in reversed(context.local_scopes):
            if node.id in scope:
                node.ptr = scope[node.id]
                return node.ptr
    elif kind is ast.Attribute:
        node.__dict__.pop("caller", None)  # of a method, when the tree was used before
    builder = _BUILDERS.get(kind)
    return builder(context, node) if builder else _build(transformer, context, node)
