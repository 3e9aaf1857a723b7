"""From a PTX module to a C file that the emulator loads: one C function for each PTX function.

Generated code includes native/kernel.h and exports one symbol, `cudacheck_module`.
"""

from __future__ import annotations

import re

from tools.cudacheck import instructions
from tools.cudacheck.failures import UnsupportedPtxError
from tools.cudacheck.ptx import (
    Brace,
    Call,
    Function,
    Guard,
    Instruction,
    Label,
    Module,
    Statement,
    Variable,
    bits,
    parse,
)

_SHARED_ALIGNMENT = 16
_SPECIAL = {
    f"%{name}.{axis}": f"t->{name}[{index}]"
    for name in ("tid", "ntid", "ctaid", "nctaid")
    for index, axis in enumerate("xyz")
} | {
    "%laneid": "t->laneid",
    "%warpid": "t->warpid",
    "WARP_SZ": "32u",
    "%lanemask_eq": "(1u << t->laneid)",
    "%lanemask_lt": "((1u << t->laneid) - 1)",
    "%lanemask_le": "((2u << t->laneid) - 1)",
    "%lanemask_gt": "(~((2u << t->laneid) - 1))",
    "%lanemask_ge": "(~((1u << t->laneid) - 1))",
}
_HEX_FLOAT = re.compile(r"0[fF]([0-9a-fA-F]{8})|0[dD]([0-9a-fA-F]{16})")
_INTEGER = re.compile(r"-?\d+|0x[0-9a-fA-F]+")
_SYMBOL = re.compile(r"([\w$.]+)(?:\+(-?\d+))?")
_ADDRESS = re.compile(r"\[\s*([%\w$.]+)\s*(?:\+\s*(-?\d+))?\s*\]")


def translate(ptx: str) -> str:
    """The C file of a PTX module. Raises UnsupportedPtxError for what has no translation."""
    return _ModuleTranslator(parse(ptx)).run()


def mangled(name: str) -> str:
    """A PTX name as a C identifier that no other name maps to and that C does not know."""
    return "ptx_" + name.replace("_", "__").replace("$", "_d").replace(".", "_o").replace("%", "_p")


class _ModuleTranslator:
    """What the functions of a module share: its variables, its functions, and who calls whom."""

    def __init__(self, module: Module) -> None:
        self.module = module
        self.functions = {function.name: function for function in module.functions}
        self.addresses: dict[str, str] = {}
        self.shared_offsets: dict[str, tuple[int, int]] = {}  # name -> offset, bytes
        self.shared_bytes = 0
        self.shared_granule = 4
        self.address_taken: set[str] = set()
        self.translated: dict[str, _FunctionTranslator] = {}

    def run(self) -> str:
        variables = [self.declare(variable) for variable in self.module.variables]
        prototypes = [f"{self.signature(function)};" for function in self.module.functions]
        bodies = []
        for function in self.module.functions:
            self.translated[function.name] = translator = _FunctionTranslator(function, self)
            bodies += [f"{self.signature(function)} {{", *translator.run(), "}"]
        lines = ['#include "kernel.h"', *filter(None, variables), *prototypes, *bodies, *self.table()]
        return "\n".join(lines) + "\n"

    def declare(self, variable: Variable) -> str:
        """C definition of a variable outside of functions; shared memory has a place instead."""
        if variable.space == "shared":
            self.place_shared(variable)
            return ""
        name, initial = mangled(variable.name), variable.initial
        self.addresses[variable.name] = f"(u64){name}"
        if initial and not initial.startswith("{"):
            initial = f"{{{initial}}}"
        definition = f"static u{bits(variable.type)} {name}[{variable.count or 1}] __attribute__((aligned(16)))"
        return definition + (f" = {initial};" if initial else ";")

    def place_shared(self, variable: Variable) -> None:
        if variable.count == 0:
            self.addresses[variable.name] = "(u64)t->shared_dynamic"
            return
        align = max(variable.align, _SHARED_ALIGNMENT)
        offset = -(-self.shared_bytes // align) * align
        self.shared_bytes = offset + variable.bytes
        self.shared_offsets[variable.name] = offset, variable.bytes
        self.addresses[variable.name] = f"(u64)(t->shared_static + {offset})"

    def signature(self, function: Function) -> str:
        """Entries get an array of pointers to parameters, as a launch has it; other functions each by its own."""
        if function.is_entry:
            return f"static void {mangled(function.name)}(Thread *t, void **parameters)"
        names = [function.result, *function.parameters] if function.result else function.parameters
        return f"static void {mangled(function.name)}(Thread *t{''.join(f', u8 *{mangled(name)}' for name in names)})"

    def table(self) -> list[str]:
        """The exported description of the module."""
        entries = [function.name for function in self.module.functions if function.is_entry]
        rows = []
        for name in entries:
            reached = [self.translated[other] for other in self.reachable(name)]
            symbols = set().union(*(translator.shared_symbols for translator in reached))
            shared = sum(self.shared_offsets[symbol][1] for symbol in symbols if symbol in self.shared_offsets)
            cooperates = int(any(translator.cooperates for translator in reached))
            rows.append(f'    {{"{name}", {mangled(name)}, {cooperates}, {shared}}},')
        return [
            "static const Kernel kernels[] = {",
            *rows,
            "};",
            "const ModuleInfo cudacheck_module = "
            f"{{kernels, {len(entries)}, {self.shared_bytes}, {self.shared_granule}}};",
        ]

    def reachable(self, name: str) -> set[str]:
        """A function and all that it may call; a call by address may reach any function whose address is taken."""
        found, pending = set(), [name]
        while pending:
            current = pending.pop()
            if current in found:
                continue
            found.add(current)
            translator = self.translated[current]
            pending += translator.calls & self.functions.keys()
            pending += self.address_taken if translator.calls_by_address else ()
        return found


class _FunctionTranslator:
    """Statements of one function, and what they reveal about it; the `Context` of `instructions`."""

    def __init__(self, function: Function, module: _ModuleTranslator) -> None:
        self.function, self.module = function, module
        self.cooperates = False
        self.calls: set[str] = set()
        self.calls_by_address = False
        self.shared_symbols: set[str] = set()
        self.local = {*function.parameters, *([function.result] if function.result else [])}

    def run(self) -> list[str]:
        """C lines of the body."""
        lines = []
        if self.function.is_entry:
            names = enumerate(self.function.parameters)
            lines = [f"u8 *{mangled(name)} = parameters[{index}];" for index, name in names]
        return lines + [self.statement(statement) for statement in self.function.body]

    def statement(self, statement: Statement) -> str:
        match statement:
            case Brace(text):
                return text
            case Label(name):
                return f"{mangled(name)}:;"
            case Variable():
                return self.declaration(statement)
            case Call():
                return _guarded(statement.guard, self.call(statement))
            case Instruction("bra"):
                return _guarded(statement.guard, f"goto {mangled(statement.operands[-1])};")
            case Instruction():
                return _guarded(statement.guard, instructions.statement(statement, self))

    def declaration(self, variable: Variable) -> str:
        """C declarations of registers and of memory that the thread has for itself."""
        if variable.space == "shared":
            self.module.place_shared(variable)
            return ""
        if variable.space == "reg":
            names = [variable.name]
            if variable.registers is not None:
                names = [f"{variable.name}{number}" for number in range(variable.registers)]
            return f"u{bits(variable.type)} {', '.join(f'{mangled(name)} = 0' for name in names)};"
        self.local.add(variable.name)
        name, size = mangled(variable.name), max(variable.bytes, 8)
        declaration = f"u8 {name}[{size}] __attribute__((aligned({max(16, variable.align)})));"
        if variable.space == "local":  # not zero by chance: reading it before writing shows
            declaration += f" memset({name}, 0xCB, {size});"
        return declaration

    def call(self, call: Call) -> str:
        arguments = [mangled(name) for name in ([call.result] if call.result else []) + call.arguments]
        if call.target == "vprintf":
            result = f"store32((u64){arguments[0]}, " if call.result else "("
            pointers = ", ".join(
                f"({kind} *)load64((u64){mangled(name)})"
                for kind, name in zip(("const char", "const u8"), call.arguments, strict=True)
            )
            return f"{result}(u32)t->runtime->print({pointers}));"
        if call.target == "__assertfail":
            message = f"(const char *)load64((u64){mangled(call.arguments[0])})"
            return f"t->runtime->fail(t, {call.line}, {message});"
        all_arguments = ", ".join(["t", *arguments])
        if call.target.startswith("%"):
            self.calls_by_address = True
            pointer = f"void (*)(Thread *{', u8 *' * len(arguments)})"
            return f"(({pointer}){self.register(call.target)})({all_arguments});"
        if call.target not in self.module.functions:
            raise UnsupportedPtxError(f"line {call.line}: call of {call.target}")
        self.calls.add(call.target)
        return f"{mangled(call.target)}({all_arguments});"

    # What `instructions` asks for

    def register(self, operand: str) -> str:
        if not operand.startswith("%"):
            raise ValueError(f"{operand} is no register")
        return mangled(operand)

    def value(self, operand: str) -> str:
        if operand in _SPECIAL:
            return _SPECIAL[operand]
        if operand.startswith("%"):
            return mangled(operand)
        if operand in ("true", "false"):
            return str(int(operand == "true"))
        match = _HEX_FLOAT.fullmatch(operand)
        if match:
            return f"0x{match[1]}u" if match[1] else f"0x{match[2]}ull"
        if _INTEGER.fullmatch(operand):
            return f"{int(operand, 0) % 2**64}ull"
        match = _SYMBOL.fullmatch(operand)
        if match is None:
            raise ValueError(f"operand {operand}")
        return f"({self.symbol(match[1])} + {match[2] or 0})"

    def address(self, operand: str) -> str:
        match = _ADDRESS.fullmatch(operand)
        if match is None:
            raise ValueError(f"address {operand}")
        base = mangled(match[1]) if match[1].startswith("%") else self.symbol(match[1])
        return f"{base} + {match[2] or 0}ll"

    def symbol(self, name: str) -> str:
        """The address of a variable or function."""
        if name in self.local:
            return f"(u64){mangled(name)}"
        if name in self.module.addresses:
            self.shared_symbols.add(name)
            return self.module.addresses[name]
        if name in self.module.functions:
            self.module.address_taken.add(name)
            return f"(u64){mangled(name)}"
        raise ValueError(f"symbol {name}")

    def touches_shared(self, bytes_: int) -> None:
        self.module.shared_granule = min(self.module.shared_granule, bytes_)


def _guarded(guard: Guard | None, code: str) -> str:
    if guard is None:
        return code
    return f"if ({'!' if guard.negated else ''}{mangled(guard.register)}) {{ {code} }}"
