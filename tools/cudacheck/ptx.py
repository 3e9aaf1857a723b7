"""Reading PTX: modules, functions, variables and instructions, as plain data and without their meaning.

Understands what LLVM's NVPTX backend writes for Taichi, not all that the PTX ISA allows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from tools.cudacheck.failures import UnsupportedPtxError

_DIRECTIVE_LINE = re.compile(r"^[ \t]*\.(version|target|address_size|loc|file|section)\b.*$", re.MULTILINE)
_COMMENT = re.compile(r"//[^\n]*")
_FUNCTION = re.compile(
    r"(?:\.visible|\.weak|\.extern|\s)*\.(?P<kind>entry|func)\s*"
    r"(?:\((?P<result>[^)]*)\)\s*)?(?P<name>[\w$.]+)\s*(?:\((?P<parameters>[^)]*)\))?(?P<attributes>[^;{]*)"
)
_VARIABLE = re.compile(
    r"(?:\.visible\s+|\.weak\s+|\.extern\s+)?\.(?P<space>global|const|shared|local|param|reg)\s+"
    r"(?:\.align\s+(?P<align>\d+)\s+)?(?:\.v[24]\s+)?\.(?P<type>\w+)\s+(?P<name>[%\w$.]+)"
    r"(?:<(?P<registers>\d+)>)?(?P<array>\[(?P<count>\d*)\])?\s*(?:=\s*(?P<initial>.*))?",
    re.DOTALL,
)
_LABEL = re.compile(r"\s*([$\w]+)\s*:(?!:)")
_GUARD = re.compile(r"@(?P<negated>!?)(?P<register>%\w+)\s+")
_CALL = re.compile(
    r"call(?:\.uni)?\s*(?:\(\s*(?P<result>[\w$]+)\s*\)\s*,)?\s*(?P<target>[%\w$.]+)\s*(?:,\s*\((?P<arguments>[^)]*)\))?",
)


def bits(ptx_type: str) -> int:
    """Width of a PTX type (`f32`, `b8`, `pred`, `f16x2`) in bits; a predicate takes 8 in C."""
    if ptx_type == "pred":
        return 8
    if ptx_type == "f16x2":
        return 32
    return int(re.sub(r"\D", "", ptx_type))


@dataclass(frozen=True)
class Variable:
    """A declaration in some state space, registers and parameters included."""

    space: str
    type: str
    name: str
    align: int = 1
    count: int | None = None  # array length; None: a scalar, 0: `[]`, memory that the launch provides
    registers: int | None = None  # `%r<5>` declares %r0 to %r4
    initial: str | None = None  # C accepts PTX's initialisers as they are

    @property
    def bytes(self) -> int:
        """Size in memory."""
        return bits(self.type) // 8 * (1 if self.count is None else self.count)


@dataclass(frozen=True)
class Label:
    """A branch target."""

    name: str


@dataclass(frozen=True)
class Brace:
    """Begin or end of a scope of declarations."""

    text: str


@dataclass(frozen=True)
class Guard:
    """The predicate of an instruction."""

    register: str
    negated: bool


@dataclass(frozen=True)
class Call:
    """A call; `target` is a function's name, or a register for a call by address."""

    target: str
    result: str | None
    arguments: list[str]
    line: int
    guard: Guard | None = None


@dataclass(frozen=True)
class Instruction:
    """Any other instruction: `ld.global.f32 %f1, [%rd1+4];` has opcode ld, modifiers (global, f32)."""

    opcode: str
    modifiers: tuple[str, ...]
    operands: list[str]
    line: int
    guard: Guard | None = None

    @property
    def type(self) -> str:
        """The last modifier, where PTX has the type of most instructions."""
        return self.modifiers[-1] if self.modifiers else ""

    def one_of(self, *choices: str) -> str | None:
        """The first of the modifiers that is among `choices`."""
        return next((modifier for modifier in self.modifiers if modifier in choices), None)


Statement = Variable | Label | Brace | Call | Instruction


@dataclass(frozen=True)
class Function:
    """An entry (a kernel) or a device function with its body."""

    name: str
    is_entry: bool
    result: str | None
    parameters: list[str]
    body: list[Statement]


@dataclass
class Module:
    """What one PTX file declares and defines."""

    variables: list[Variable] = field(default_factory=list)
    functions: list[Function] = field(default_factory=list)


def parse(text: str) -> Module:
    """Read a PTX module. Raises UnsupportedPtxError, naming the line, for what is not understood."""
    text = _DIRECTIVE_LINE.sub("", _COMMENT.sub("", text))
    module, position = Module(), 0
    while text[position:].strip():
        match = _FUNCTION.match(text, _skip_space(text, position))
        if match is None:
            end = text.find(";", position)
            if end < 0:
                raise UnsupportedPtxError(f"line {_line(text, position)}: no end of statement")
            module.variables.append(_variable(text[position:end], _line(text, position)))
            position = end + 1
        elif text[match.end()] == ";":
            position = match.end() + 1
        else:
            end = _closing_brace(text, match.end())
            module.functions.append(_function(match, text[match.end() + 1 : end], _line(text, match.end())))
            position = end + 1
    return module


def split_operands(text: str) -> list[str]:
    """Split at commas outside of brackets."""
    operands, depth, start = [], 0, 0
    for position, character in enumerate(text):
        if character in "{[(":
            depth += 1
        elif character in "}])":
            depth -= 1
        elif character == "," and depth == 0:
            operands.append(text[start:position].strip())
            start = position + 1
    last = text[start:].strip()
    return [*operands, last] if last else operands


def _skip_space(text: str, position: int) -> int:
    while position < len(text) and text[position].isspace():
        position += 1
    return position


def _line(text: str, position: int) -> int:
    """Line number of what follows at this position."""
    return text.count("\n", 0, _skip_space(text, position)) + 1


def _closing_brace(text: str, opening: int) -> int:
    depth = 0
    for match in re.compile(r"[{}]").finditer(text, opening):
        depth += 1 if match[0] == "{" else -1
        if depth == 0:
            return match.start()
    raise UnsupportedPtxError(f"line {_line(text, opening)}: a brace is never closed")


def _variable(text: str, line: int) -> Variable:
    match = _VARIABLE.fullmatch(text.strip())
    if match is None:
        raise UnsupportedPtxError(f"line {line}: declaration {text.strip()[:80]!r}")
    return Variable(
        space=match["space"],
        type=match["type"],
        name=match["name"],
        align=int(match["align"] or 1),
        count=int(match["count"] or 0) if match["array"] else None,
        registers=int(match["registers"]) if match["registers"] else None,
        initial=match["initial"],
    )


def _function(header: re.Match[str], body: str, line: int) -> Function:
    return Function(
        name=header["name"],
        is_entry=header["kind"] == "entry",
        result=_parameter_name(header["result"]) if header["result"] else None,
        parameters=[_parameter_name(text) for text in (header["parameters"] or "").split(",") if text.strip()],
        body=list(_statements(body, line)),
    )


def _parameter_name(declaration: str) -> str:
    return re.sub(r"\[\d*\]", "", declaration).split()[-1]


def _statements(body: str, line: int) -> Iterator[Statement]:
    position = 0
    while True:
        start = _skip_space(body, position)
        line += body.count("\n", position, start)
        if start == len(body):
            return
        label = _LABEL.match(body, start)
        if body[start] in "{}":
            yield Brace(body[start])
            position = start + 1
        elif label and not body.startswith(".callprototype", _skip_space(body, label.end())):
            yield Label(label[1])
            position = label.end()
        else:  # a prototype only types a call by address: C needs no such thing
            position = body.index(";", start) + 1
            statement = body[start : position - 1].strip()
            if not label and not statement.startswith(".pragma"):
                yield _statement(statement, line)
            line += body.count("\n", start, position)


def _statement(text: str, line: int) -> Statement:
    if text.startswith("."):
        return _variable(text, line)
    guard = None
    match = _GUARD.match(text)
    if match:
        guard = Guard(match["register"], match["negated"] == "!")
        text = text[match.end() :]
    opcode, *operands = text.split(None, 1)
    name, *modifiers = opcode.split(".")
    if name == "call":
        call = _CALL.fullmatch(re.sub(r"\s*,\s*prototype_\d+$", "", " ".join(text.split())))
        if call is None:
            raise UnsupportedPtxError(f"line {line}: call {text[:80]!r}")
        return Call(call["target"], call["result"], split_operands(call["arguments"] or ""), line, guard)
    return Instruction(name, tuple(modifiers), split_operands("".join(operands)), line, guard)
