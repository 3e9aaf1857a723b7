"""Faster start-up: what Taichi 1.7.4 does in Python before it can even look a kernel up in its cache.

For every node of a kernel's syntax tree, Taichi lays out the source line and a row of carets below it with `textwrap`,
in case there is an error: half of the time from a kernel's first call to its launch. Here the position is the file,
the line and its text, which is what a reader needs.
"""

from __future__ import annotations

import ast

import taichi as ti
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

_KNOWN = (1, 7, 4)  # the method below is private: another Taichi keeps its own


def shorten_positions() -> None:
    """Replace the layout of source positions in Taichi's error messages by one line each."""
    if ti.__version__ == _KNOWN:
        ASTTransformerContext.get_pos_info = _position


def _position(context: ASTTransformerContext, node: ast.stmt | ast.expr) -> str:
    line = node.lineno + context.lineno_offset
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n{context.src[node.lineno - 1]}\n'
