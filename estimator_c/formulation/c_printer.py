"""CasADi function -> one plain C function: straight-line code, constants in place, no runtime, no memory.

CasADi's own code generator wraps each function in a dozen exported bookkeeping functions and null checks; the
instruction list it works from is public and small, so we print that.
"""

from __future__ import annotations

import casadi as ca

BINARY = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
UNARY = {
    ca.OP_NEG: "-{0}",
    ca.OP_EXP: "exp({0})",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_ASSIGN: "{0}",
}


def c_signature(function: ca.Function) -> str:
    """Prototype without the semicolon; vectors are arrays with their length."""
    inputs = [f"const double {function.name_in(k)}[{function.numel_in(k)}]" for k in range(function.n_in())]
    outputs = [f"double {function.name_out(k)}[{function.numel_out(k)}]" for k in range(function.n_out())]
    return f"void {function.name()}({', '.join(inputs + outputs)})"


def c_function(function: ca.Function) -> str:
    """Body of `function` in C11.

    All inputs are read before the first output is written, so an output may share memory with an input.

    Raises
    ------
    NotImplementedError
        An operation this printer does not know, or a sparse output.
    """
    for k in range(function.n_out()):
        if not function.sparsity_out(k).is_dense():
            raise NotImplementedError(f"{function.name()}: output {function.name_out(k)} is sparse")
    reads: list[str] = []
    body: list[str] = []
    writes: list[str] = []
    value: dict[int, str] = {}  # CasADi's work slot -> the C name (or literal) that holds it now
    loaded: dict[tuple[int, int], str] = {}

    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        args, outs = function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            value[outs[0]] = _literal(function.instruction_constant(k))
        elif op == ca.OP_INPUT:
            source = (args[0], args[1])
            if source not in loaded:
                loaded[source] = f"{function.name_in(args[0])}_{args[1]}"
                reads.append(f"    const double {loaded[source]} = {function.name_in(args[0])}[{args[1]}];")
            value[outs[0]] = loaded[source]
        elif op == ca.OP_OUTPUT:
            writes.append(f"    {function.name_out(outs[0])}[{outs[1]}] = {value[args[0]]};")
        else:
            if op in BINARY:
                text = f"{value[args[0]]} {BINARY[op]} {value[args[1]]}"
            elif op in UNARY:
                text = UNARY[op].format(value[args[0]])
            else:
                raise NotImplementedError(f"{function.name()}: CasADi operation {op} has no C form here")
            body.append(f"    const double t{k} = {text};")
            value[outs[0]] = f"t{k}"
    return "\n".join([c_signature(function), "{", *reads, *body, *writes, "}", ""])


def _literal(number: float) -> str:
    text = repr(float(number))
    text = text if any(mark in text for mark in ".en") else text + ".0"
    return f"({text})" if text.startswith("-") else text
