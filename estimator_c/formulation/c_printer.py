"""CasADi function -> one plain C function: straight-line code, constants in place, no runtime, no memory.

CasADi's own code generator wraps each function in a dozen exported bookkeeping functions and null checks; the
instruction list it works from is public and small, so we print that.
"""

from __future__ import annotations

import casadi as ca

from .real import DOUBLE, Real

BINARY = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*"}
UNARY = {
    ca.OP_NEG: "-{0}",
    ca.OP_EXP: "net_exp({0})",
    ca.OP_TWICE: "{two} * {0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_ASSIGN: "{0}",
}


def c_signature(function: ca.Function, name: str) -> str:
    """Prototype of `function` under that name, without the semicolon; vectors are arrays with their length."""
    inputs = [f"const real_t {function.name_in(k)}[{function.numel_in(k)}]" for k in range(function.n_in())]
    outputs = [f"real_t {function.name_out(k)}[{function.numel_out(k)}]" for k in range(function.n_out())]
    return f"void {name}({', '.join(inputs + outputs)})"


def c_function(function: ca.Function, real: Real = DOUBLE) -> str:
    """`function` as a static C function of its name without "net_", on real_t of real.h, its constants of that type.

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
    inverse: dict[str, str] = {}  # C name -> the C name of its inverse: divided once, multiplied from then on

    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        args, outs = function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            value[outs[0]] = real.literal(function.instruction_constant(k))
        elif op == ca.OP_INPUT:
            source = (args[0], args[1])
            if source not in loaded:
                loaded[source] = f"{function.name_in(args[0])}_{args[1]}"
                reads.append(f"    const real_t {loaded[source]} = {function.name_in(args[0])}[{args[1]}];")
            value[outs[0]] = loaded[source]
        elif op == ca.OP_OUTPUT:
            writes.append(f"    {function.name_out(outs[0])}[{outs[1]}] = {value[args[0]]};")
        else:
            if op in (ca.OP_INV, ca.OP_DIV):
                below = value[args[-1]]
                if below not in inverse:
                    inverse[below] = f"i{k}"
                    body.append(f"    const real_t i{k} = {real.literal(1.0)} / {below};")
                if op == ca.OP_INV:
                    value[outs[0]] = inverse[below]
                    continue
                text = f"{value[args[0]]} * {inverse[below]}"
            elif op in BINARY:
                text = f"{value[args[0]]} {BINARY[op]} {value[args[1]]}"
            elif op in UNARY:
                text = UNARY[op].format(value[args[0]], two=real.literal(2.0))
            else:
                raise NotImplementedError(f"{function.name()}: CasADi operation {op} has no C form here")
            body.append(f"    const real_t t{k} = {text};")
            value[outs[0]] = f"t{k}"
    return "\n".join(["static " + c_signature(function, function.name().removeprefix("net_")), "{", *reads, *body, *writes, "}", ""])

