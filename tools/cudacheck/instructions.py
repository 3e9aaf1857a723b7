"""PTX instructions as C statements: a table of small functions, one for each family of opcodes.

A register holds untyped bits (see native/kernel.h), so most functions read operands with the instruction's type, build
a C expression and store its bits. `context` knows what names stand for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tools.cudacheck.failures import UnsupportedPtxError
from tools.cudacheck.ptx import Instruction, bits, split_operands

_COMPARISONS = {
    "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
    "lo": "<", "ls": "<=", "hi": ">", "hs": ">=",  # unsigned
}  # fmt: skip
_BITWISE = {"and": "&", "or": "|", "xor": "^"}
_ROUNDINGS = {"rni": "rint", "rzi": "trunc", "rmi": "floor", "rpi": "ceil"}
_FLOAT_FUNCTIONS = {
    "sqrt": "sqrt", "ex2": "exp2", "lg2": "log2", "sin": "sin", "cos": "cos", "tanh": "tanh", "abs": "fabs",
}  # fmt: skip
_MEMORY_MODIFIERS = ("shared", "local", "param", "const", "global")
_DIRECTED = ("rz", "rm", "rp")  # roundings of arithmetic that C has no operator for


class Context(Protocol):
    """The function that is being translated."""

    cooperates: bool

    def value(self, operand: str) -> str:
        """C expression for an operand's bits."""

    def address(self, operand: str) -> str:
        """C expression for `[base+offset]`."""

    def register(self, operand: str) -> str:
        """C variable of a register."""

    def touches_shared(self, bytes_: int) -> None:
        """Note how narrow the accesses to shared memory are."""


def statement(instruction: Instruction, context: Context) -> str:
    """The C statement of an instruction. Raises UnsupportedPtxError for what has no translation."""
    translate = _TABLE.get(instruction.opcode)
    name = ".".join((instruction.opcode, *instruction.modifiers))
    if translate is None:
        raise UnsupportedPtxError(f"line {instruction.line}: instruction {name}")
    try:
        return translate(instruction, context)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise UnsupportedPtxError(f"line {instruction.line}: this form of {name} ({error!r})") from error


# ---- values ----------------------------------------------------------------


def c_type(ptx_type: str, width: int | None = None) -> str:
    """C integer type: signed for `s32`, unsigned for every other, `b32` and `f32` among them."""
    return ("s" if ptx_type[0] == "s" else "u") + str(width or bits(ptx_type))


def _is_float(ptx_type: str) -> bool:
    return ptx_type in ("f16", "f32", "f64")


def _typed(ptx_type: str, operand: str, context: Context) -> str:
    """An operand's value as that type."""
    value = context.value(operand)
    if _is_float(ptx_type):
        return f"as_{ptx_type}({value})"
    return value if ptx_type == "pred" else f"(({c_type(ptx_type)})({value}))"


def _bits_of(ptx_type: str, expression: str) -> str:
    return f"bits_{ptx_type}({expression})" if _is_float(ptx_type) else f"(u{bits(ptx_type)})({expression})"


def _assign(ptx_type: str, target: str, expression: str, context: Context) -> str:
    return f"{context.register(target)} = {_bits_of(ptx_type, expression)};"


def _predicate(operand: str, context: Context) -> str:
    negated, name = operand.startswith("!"), operand.removeprefix("!")
    return ("!" if negated else "") + context.value(name)


def _pair(operand: str) -> tuple[str, str | None]:
    """The two targets of `%r1|%p1`."""
    first, _, second = operand.partition("|")
    return first, second or None


def _saturated(instruction: Instruction, expression: str) -> str:
    return f"fmin(fmax({expression}, 0), 1)" if "sat" in instruction.modifiers else expression


def _require_nearest(instruction: Instruction) -> None:
    if instruction.one_of(*_DIRECTED):
        raise ValueError("directed rounding")


# ---- arithmetic ------------------------------------------------------------


def _add_or_subtract(i: Instruction, context: Context) -> str:
    if "cc" in i.modifiers:
        raise ValueError("carry")
    sign = "+" if i.opcode == "add" else "-"
    if _is_float(i.type):
        _require_nearest(i)
    a, b = (_typed(i.type, operand, context) for operand in i.operands[1:])
    if not _is_float(i.type):
        a, b = (f"({c_type('u', bits(i.type))}){x}" for x in (a, b))  # wraps
    return _assign(i.type, i.operands[0], _saturated(i, f"{a} {sign} {b}"), context)


def _integer_product(i: Instruction, context: Context) -> tuple[str, int]:
    """Expression and width of mul's three forms: the low half, the high half and all of the product."""
    width = bits(i.type)
    a, b = (f"({c_type(i.type, 2 * width)}){_typed(i.type, operand, context)}" for operand in i.operands[1:3])
    if "wide" in i.modifiers:
        return f"(u{2 * width})({a} * {b})", 2 * width
    shift = f" >> {width}" if "hi" in i.modifiers else ""
    return f"(u{width})(({a} * {b}){shift})", width


def _multiply(i: Instruction, context: Context) -> str:
    if _is_float(i.type):
        _require_nearest(i)
        a, b = (_typed(i.type, operand, context) for operand in i.operands[1:])
        return _assign(i.type, i.operands[0], _saturated(i, f"{a} * {b}"), context)
    product, width = _integer_product(i, context)
    return f"{context.register(i.operands[0])} = (u{width})({product});"


def _multiply_add(i: Instruction, context: Context) -> str:
    if _is_float(i.type):
        _require_nearest(i)
        a, b, c = (_typed(i.type, operand, context) for operand in i.operands[1:])
        fused = "__builtin_fma" if i.type == "f64" else "__builtin_fmaf"
        return _assign(i.type, i.operands[0], _saturated(i, f"{fused}({a}, {b}, {c})"), context)
    product, width = _integer_product(i, context)
    return f"{context.register(i.operands[0])} = (u{width})({product} + (u{width})({context.value(i.operands[3])}));"


def _divide(i: Instruction, context: Context) -> str:
    a, b = (_typed(i.type, operand, context) for operand in i.operands[1:])
    if _is_float(i.type):
        _require_nearest(i)
        return _assign(i.type, i.operands[0], f"{a} / {b}", context)
    function = "divide" if i.opcode == "div" else "remainder"
    return _assign(i.type, i.operands[0], f"{function}_{i.type}({a}, {b})", context)


def _min_or_max(i: Instruction, context: Context) -> str:
    a, b = (_typed(i.type, operand, context) for operand in i.operands[1:])
    if _is_float(i.type):  # as in C, the other operand where one is NaN
        return _assign(i.type, i.operands[0], f"f{i.opcode}{'' if i.type == 'f64' else 'f'}({a}, {b})", context)
    return _assign(i.type, i.operands[0], f"{a} {'<' if i.opcode == 'min' else '>'} {b} ? {a} : {b}", context)


def _negate(i: Instruction, context: Context) -> str:
    value = _typed(i.type, i.operands[1], context)
    return _assign(i.type, i.operands[0], f"-{value}" if _is_float(i.type) else f"0 - (u64){value}", context)


def _absolute(i: Instruction, context: Context) -> str:
    if _is_float(i.type):
        return _float_function(i, context)
    value = _typed(i.type, i.operands[1], context)
    return _assign(i.type, i.operands[0], f"{value} < 0 ? 0 - (u64){value} : (u64){value}", context)


def _float_function(i: Instruction, context: Context) -> str:
    suffix = "" if i.type == "f64" else "f"
    call = f"{_FLOAT_FUNCTIONS[i.opcode]}{suffix}({_typed(i.type, i.operands[1], context)})"
    return _assign(i.type, i.operands[0], call, context)


def _reciprocal(i: Instruction, context: Context) -> str:
    value = _typed(i.type, i.operands[1], context)
    if i.opcode == "rsqrt":
        value = f"sqrt{'' if i.type == 'f64' else 'f'}({value})"
    return _assign(i.type, i.operands[0], f"1 / {value}", context)


def _copy_sign(i: Instruction, context: Context) -> str:
    sign, magnitude = (_typed(i.type, operand, context) for operand in i.operands[1:])
    return _assign(i.type, i.operands[0], f"copysign({magnitude}, {sign})", context)


# ---- bits ------------------------------------------------------------------


def _bitwise(i: Instruction, context: Context) -> str:
    a, b = (context.value(operand) for operand in i.operands[1:])
    return _assign(i.type, i.operands[0], f"{a} {_BITWISE[i.opcode]} {b}", context)


def _not(i: Instruction, context: Context) -> str:
    return _assign(i.type, i.operands[0], f"{'!' if i.type == 'pred' else '~'}{context.value(i.operands[1])}", context)


def _shift(i: Instruction, context: Context) -> str:
    ptx_type = i.type.replace("b", "u") if i.opcode == "shr" else i.type
    function = f"shift_{'left' if i.opcode == 'shl' else 'right'}_{ptx_type}"
    a, n = (context.value(operand) for operand in i.operands[1:])
    return _assign(i.type, i.operands[0], f"{function}({a}, {n})", context)


def _funnel_shift(i: Instruction, context: Context) -> str:
    low, high, n = (context.value(operand) for operand in i.operands[1:])
    n = f"((u32)({n}) > 32 ? 32 : (u32)({n}))" if "clamp" in i.modifiers else f"({n} & 31)"
    return _assign(
        i.type, i.operands[0], f"funnel_{'left' if 'l' in i.modifiers else 'right'}({low}, {high}, {n})", context
    )


def _count_bits(i: Instruction, context: Context) -> str:
    return f"{context.register(i.operands[0])} = __builtin_popcountll({_typed(i.type, i.operands[1], context)});"


def _leading_zeros(i: Instruction, context: Context) -> str:
    return f"{context.register(i.operands[0])} = leading_zeros{bits(i.type)}({context.value(i.operands[1])});"


def _find_highest_bit(i: Instruction, context: Context) -> str:
    if i.type[0] == "s" or "shiftamt" in i.modifiers:
        raise ValueError("signed or shiftamt")
    width = bits(i.type)  # all ones, which is -1, where there is none
    count = f"leading_zeros{width}({context.value(i.operands[1])})"
    return f"{context.register(i.operands[0])} = (u32)({width - 1} - (s32){count});"


def _reverse_bits(i: Instruction, context: Context) -> str:
    call = f"reverse_bits{bits(i.type)}({context.value(i.operands[1])})"
    return _assign(i.type, i.operands[0], call, context)


def _permute(i: Instruction, context: Context) -> str:
    if len(i.modifiers) > 1:
        raise ValueError("mode")
    arguments = ", ".join(context.value(operand) for operand in i.operands[1:])
    return f"{context.register(i.operands[0])} = permute_bytes({arguments});"


def _bit_field(i: Instruction, context: Context) -> str:
    function = "extract" if i.opcode == "bfe" else "insert"
    arguments = ", ".join(context.value(operand) for operand in i.operands[1:])
    return _assign(i.type, i.operands[0], f"{function}_{i.type}({arguments})", context)


# ---- comparison, selection, conversion --------------------------------------


def _float_comparison(comparison: str, a: str, b: str) -> str:
    unordered = f"({a} != {a} || {b} != {b})"
    if comparison in ("num", "nan"):
        return unordered if comparison == "nan" else f"!{unordered}"
    if comparison == "ne":  # C's != holds for NaN, PTX's does not
        return f"(!{unordered} && {a} != {b})"
    if comparison in _COMPARISONS:
        return f"({a} {_COMPARISONS[comparison]} {b})"
    return f"({unordered} || {a} {_COMPARISONS[comparison.removesuffix('u')]} {b})"


def _compare(i: Instruction, context: Context) -> str:
    a, b = (_typed(i.type, operand, context) for operand in i.operands[1:3])
    if _is_float(i.type):
        result = _float_comparison(i.modifiers[0], a, b)
    else:
        result = f"({a} {_COMPARISONS[i.modifiers[0]]} {b})"
    target, complement = _pair(i.operands[0])
    both = i.one_of(*_BITWISE)
    if both:
        result = f"({result} {_BITWISE[both]} {_predicate(i.operands[3], context)})"
    if complement is None:
        return f"{context.register(target)} = {result};"
    if both:
        raise ValueError("complement of a combination")
    return f"{context.register(target)} = {result}; {context.register(complement)} = !{context.register(target)};"


def _select(i: Instruction, context: Context) -> str:
    a, b, condition = (context.value(operand) for operand in i.operands[1:])
    return f"{context.register(i.operands[0])} = {condition} ? {a} : {b};"


def _select_by_sign(i: Instruction, context: Context) -> str:
    a, b = (context.value(operand) for operand in i.operands[1:3])
    return f"{context.register(i.operands[0])} = {_typed(i.type, i.operands[3], context)} >= 0 ? {a} : {b};"


def _convert(i: Instruction, context: Context) -> str:
    to, source = i.modifiers[-2:]
    value, target = _typed(source, i.operands[1], context), i.operands[0]
    rounding = i.one_of(*_ROUNDINGS)
    if rounding:
        value = f"{_ROUNDINGS[rounding]}({value})"
    if _is_float(to):
        if not _is_float(source):
            _require_nearest(i)
            value = f"({'double' if to == 'f64' else 'float'}){value}"
        return _assign(to, target, _saturated(i, value), context)
    if _is_float(source):
        if rounding is None:
            raise ValueError("no rounding")
        return f"{context.register(target)} = (s64)to_{to}({value});"
    if "sat" in i.modifiers:
        raise ValueError("saturation of integers")
    # The target register may be wider than the type, and is filled by the type's sign.
    return f"{context.register(target)} = ({c_type(to, 64)})({c_type(to)})({value});"


def _test_property(i: Instruction, context: Context) -> str:
    value = _typed(i.type, i.operands[1], context)
    test = {
        "finite": f"isfinite({value}) != 0",
        "infinite": f"isinf({value}) != 0",
        "notanumber": f"isnan({value}) != 0",
        "number": f"isnan({value}) == 0",
    }[i.modifiers[0]]
    return f"{context.register(i.operands[0])} = {test};"


# ---- memory ----------------------------------------------------------------


def _checks(i: Instruction, bytes_: int, kind: str, context: Context) -> str:
    """C statements that check an access at `a`; none for a thread's own parameters and local memory."""
    space = i.one_of(*_MEMORY_MODIFIERS)
    if space in ("param", "local", "const"):
        return ""
    checks = f"require_aligned(t, a, {bytes_}, {i.line}); "
    if space == "shared":
        context.touches_shared(bytes_)
        checks += f"t->runtime->shared(t, a, {bytes_}, {kind}, {i.line}); "
    elif space is None:
        context.touches_shared(bytes_)
        checks += f"generic_access(t, a, {bytes_}, {kind}, {i.line}); "
    return checks


def _vector(i: Instruction, operand: str) -> list[str]:
    """The registers of a load or store: of `{%r1, %r2}` with .v2 or .v4, else one."""
    return split_operands(operand.strip("{}")) if i.one_of("v2", "v4") else [operand]


def _load(i: Instruction, context: Context) -> str:
    width, targets = bits(i.type), _vector(i, i.operands[0])
    # A volatile load of shared memory is how a compare-and-swap loop begins: it is meant to race with atomics.
    kind = "SHARED_ATOMIC" if i.one_of("volatile", "relaxed", "acquire") else "SHARED_READ"
    code = f"{{ u64 a = {context.address(i.operands[1])}; {_checks(i, len(targets) * width // 8, kind, context)}"
    sign = f"(s64)(s{width})" if i.type[0] == "s" else ""
    for index, target in enumerate(targets):
        if target != "_":
            code += f"{context.register(target)} = {sign}load{width}(a + {index * width // 8}); "
    return code + "}"


def _store(i: Instruction, context: Context) -> str:
    width, sources = bits(i.type), _vector(i, i.operands[1])
    checks = _checks(i, len(sources) * width // 8, "SHARED_WRITE", context)
    code = f"{{ u64 a = {context.address(i.operands[0])}; {checks}"
    for index, source in enumerate(sources):
        code += f"store{width}(a + {index * width // 8}, {context.value(source)}); "
    return code + "}"


def _move(i: Instruction, context: Context) -> str:
    target, source = i.operands
    if target.startswith("{"):
        parts = split_operands(target.strip("{}"))
        width = bits(i.type) // len(parts)
        unpacked = (
            f"{context.register(part)} = (u{width})(v >> {index * width}); "
            for index, part in enumerate(parts)
            if part != "_"
        )
        return f"{{ u64 v = {context.value(source)}; {''.join(unpacked)}}}"
    if source.startswith("{"):
        parts = split_operands(source.strip("{}"))
        width = bits(i.type) // len(parts)
        packed = (f"(u64)(u{width})({context.value(part)}) << {index * width}" for index, part in enumerate(parts))
        return f"{context.register(target)} = {' | '.join(packed)};"
    return f"{context.register(target)} = {context.value(source)};"


def _atomic_result(operation: str, ptx_type: str, context: Context, operands: list[str]) -> str:
    """What an atomic operation leaves in memory, from `old` and `operand`."""
    kind = c_type(ptx_type)
    if operation == "add" and ptx_type == "f16x2":
        halves = (f"(u32)bits_f16(as_f16(old >> {n}) + as_f16(operand >> {n})) << {n}" for n in (0, 16))
        return " | ".join(halves)
    if operation == "add" and _is_float(ptx_type):
        return _bits_of(ptx_type, f"as_{ptx_type}(old) + as_{ptx_type}(operand)")
    return {
        "add": "old + operand",
        "exch": "operand",
        "cas": f"old == operand ? (u{bits(ptx_type)})({context.value(operands[-1])}) : old",
        "and": "old & operand",
        "or": "old | operand",
        "xor": "old ^ operand",
        "min": f"({kind})old < ({kind})operand ? old : operand",
        "max": f"({kind})old > ({kind})operand ? old : operand",
        "inc": "old >= operand ? 0 : old + 1",
        "dec": "old == 0 || old > operand ? operand : old - 1",
    }[operation]


def _atomic(i: Instruction, context: Context) -> str:
    """`atom` returns the old value, `red` does not. Threads never run at the same time, so plain C is atomic."""
    operands = i.operands[1:] if i.opcode == "atom" else i.operands
    operation = i.one_of("add", "exch", "cas", "min", "max", "and", "or", "xor", "inc", "dec") or ""
    width, kind = bits(i.type), "SHARED_EXCHANGE" if operation == "exch" else "SHARED_ATOMIC"
    result = _atomic_result(operation, i.type, context, operands)
    code = (
        f"{{ u64 a = {context.address(operands[0])}; {_checks(i, width // 8, kind, context)}"
        f"u{width} old = load{width}(a), operand = {context.value(operands[1])}; store{width}(a, {result}); "
    )
    if i.opcode == "atom" and i.operands[0] != "_":
        code += f"{context.register(i.operands[0])} = old; "
    return code + "}"


# ---- threads together -------------------------------------------------------


def _barrier(i: Instruction, context: Context) -> str:
    context.cooperates = True
    if i.modifiers[0] == "warp":
        return _warp_call("WARP_SYNC", "0", "0", "0", context.value(i.operands[0]), i.line) + "; }"
    if "red" not in i.modifiers:
        if i.operands != ["0"]:
            raise ValueError("a barrier of some of the threads")
        return f"t->runtime->barrier(t, REDUCE_NONE, 0, {i.line});"
    reduction = {"popc": "REDUCE_COUNT", "and": "REDUCE_AND", "or": "REDUCE_OR"}[i.one_of("popc", "and", "or") or ""]
    predicate = _predicate(i.operands[-1], context)
    return f"{context.register(i.operands[0])} = t->runtime->barrier(t, {reduction}, {predicate}, {i.line});"


def _warp_call(operation: str, value: str, lane: str, clamp: str, mask: str, line: int) -> str:
    """Open a scope whose last expression is the operation's result; `p` is its predicate."""
    return f"{{ u32 p; u32 v = t->runtime->warp(t, {operation}, {value}, {lane}, {clamp}, {mask}, {line}, &p)"


def _warp_result(call: str, targets: str, context: Context) -> str:
    target, predicate = _pair(targets)
    code = f"{call}; {context.register(target)} = v; "
    return code + (f"{context.register(predicate)} = p; " if predicate else "") + "}"


def _shuffle(i: Instruction, context: Context) -> str:
    context.cooperates = True
    mode = i.one_of("idx", "up", "down", "bfly") or ""
    value, lane, clamp, mask = (context.value(operand) for operand in i.operands[1:])
    return _warp_result(
        _warp_call(f"WARP_SHUFFLE_{mode.upper()}", value, lane, clamp, mask, i.line), i.operands[0], context
    )


def _vote(i: Instruction, context: Context) -> str:
    context.cooperates = True
    mode = i.one_of("ballot", "all", "any", "uni") or ""
    predicate, mask = _predicate(i.operands[1], context), context.value(i.operands[2])
    return _warp_result(
        _warp_call(f"WARP_VOTE_{mode.upper()}", predicate, "0", "0", mask, i.line), i.operands[0], context
    )


def _match(i: Instruction, context: Context) -> str:
    context.cooperates = True
    mode = i.one_of("any", "all") or ""
    value, mask = f"(u{bits(i.type)})({context.value(i.operands[1])})", context.value(i.operands[2])
    return _warp_result(_warp_call(f"WARP_MATCH_{mode.upper()}", value, "0", "0", mask, i.line), i.operands[0], context)


def _active_mask(i: Instruction, context: Context) -> str:
    return f"{context.register(i.operands[0])} = t->runtime->active_mask(t);"


def _nothing(i: Instruction, context: Context) -> str:
    return ";"


def _fixed(code: str) -> Callable[[Instruction, Context], str]:
    return lambda i, context: code.replace("LINE", str(i.line))


_TABLE: dict[str, Callable[[Instruction, Context], str]] = {
    "add": _add_or_subtract,
    "sub": _add_or_subtract,
    "mul": _multiply,
    "mad": _multiply_add,
    "fma": _multiply_add,
    "div": _divide,
    "rem": _divide,
    "min": _min_or_max,
    "max": _min_or_max,
    "neg": _negate,
    "abs": _absolute,
    "sqrt": _float_function,
    "ex2": _float_function,
    "lg2": _float_function,
    "sin": _float_function,
    "cos": _float_function,
    "tanh": _float_function,
    "rcp": _reciprocal,
    "rsqrt": _reciprocal,
    "copysign": _copy_sign,
    "and": _bitwise,
    "or": _bitwise,
    "xor": _bitwise,
    "not": _not,
    "shl": _shift,
    "shr": _shift,
    "shf": _funnel_shift,
    "popc": _count_bits,
    "clz": _leading_zeros,
    "bfind": _find_highest_bit,
    "brev": _reverse_bits,
    "prmt": _permute,
    "bfe": _bit_field,
    "bfi": _bit_field,
    "setp": _compare,
    "selp": _select,
    "slct": _select_by_sign,
    "cvt": _convert,
    "testp": _test_property,
    "ld": _load,
    "ldu": _load,
    "st": _store,
    "mov": _move,
    "cvta": _move,  # every state space lies in one address space here
    "atom": _atomic,
    "red": _atomic,
    "bar": _barrier,
    "barrier": _barrier,
    "shfl": _shuffle,
    "vote": _vote,
    "match": _match,
    "activemask": _active_mask,
    "membar": _nothing,  # threads of a block never run at the same time
    "fence": _nothing,
    "prefetch": _nothing,
    "nanosleep": _nothing,
    "ret": _fixed("return;"),
    "exit": _fixed("t->runtime->exit(t);"),
    "trap": _fixed('t->runtime->fail(t, LINE, "trap");'),
}
