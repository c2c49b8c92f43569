"""CasADi function -> one plain C function: straight-line code, constants in place, no runtime, no memory.

CasADi's own code generator wraps each function in a dozen exported bookkeeping functions and null checks; the
instruction list it works from is public and small, so we print that.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from .real import DOUBLE, Real

BINARY = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*"}
UNARY = {
    ca.OP_NEG: "-{0}",
    ca.OP_TWICE: "{two} * {0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_ASSIGN: "{0}",
}


@dataclass
class _Value:
    """A number of the function: its C text and how many gates lie before it, one after the other."""

    text: str
    depth: int = 0
    constant: float | None = None
    role: str = ""  # "exp": its argument is text; "1+exp": a gate to be
    gate: _Value | None = None  # of "1+exp": its inverse, once asked for


def c_signature(function: ca.Function, name: str) -> str:
    """Prototype of `function` under that name, without the semicolon; vectors are arrays with their length."""
    inputs = [f"const real_t {function.name_in(k)}[{function.numel_in(k)}]" for k in range(function.n_in())]
    outputs = [f"real_t {function.name_out(k)}[{function.numel_out(k)}]" for k in range(function.n_out())]
    return f"void {name}({', '.join(inputs + outputs)})"


def c_function(function: ca.Function, real: Real = DOUBLE) -> str:
    """`function` as a static C function of its name without "net_", on real_t of real.h, its constants of that type.

    All inputs are read before the first output is written, so an output may share memory with an input. exp() is known
    as part of a gate, 1/(1 + exp(a)), alone; gates that do not wait for each other are computed together.

    Raises
    ------
    NotImplementedError
        An operation this printer does not know, or a sparse output.
    """
    for k in range(function.n_out()):
        if not function.sparsity_out(k).is_dense():
            raise NotImplementedError(f"{function.name()}: output {function.name_out(k)} is sparse")
    printer = _Printer(function, real)
    head = "static " + c_signature(function, function.name().removeprefix("net_"))
    return "\n".join([head, "{", *printer.reads, *printer.body(), *printer.writes, "}", ""])


class _Printer:
    """One pass over CasADi's instructions; lines are kept by depth, so all gates of a depth follow their arguments."""

    def __init__(self, function: ca.Function, real: Real) -> None:
        self.function, self.real = function, real
        self.reads: list[str] = []
        self.writes: list[str] = []
        self.lines: dict[int, list[str]] = {0: []}
        self.gates: dict[int, int] = {}  # depth -> number of gates whose arguments have that depth
        slots: dict[int, _Value] = {}  # CasADi's work slot -> what it holds now
        loaded: dict[tuple[int, int], _Value] = {}
        for k in range(function.n_instructions()):
            op, args, outs = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
            if op == ca.OP_INPUT:
                source = (args[0], args[1])
                if source not in loaded:
                    name = f"{function.name_in(args[0])}_{args[1]}"
                    loaded[source] = _Value(name)
                    self.reads.append(f"    const real_t {name} = {function.name_in(args[0])}[{args[1]}];")
                slots[outs[0]] = loaded[source]
            elif op == ca.OP_OUTPUT:
                self.writes.append(f"    {function.name_out(outs[0])}[{outs[1]}] = {self._use(slots[args[0]])};")
            elif op == ca.OP_CONST:
                number = function.instruction_constant(k)
                slots[outs[0]] = _Value(real.literal(number), constant=number)
            else:
                slots[outs[0]] = self._compute(k, op, [slots[arg] for arg in args])

    def body(self) -> list[str]:
        """All lines between the reads and the writes."""
        text: list[str] = []
        for depth, lines in sorted(self.lines.items()):
            count = self.gates.get(depth, 0)
            if count:
                text.append(f"    real_t gate_{depth}[{count}];")
            text += lines
            if count:
                text.append(f"    net_gates(gate_{depth}, {count});")
        return text

    def _compute(self, k: int, op: int, args: list[_Value]) -> _Value:
        if op == ca.OP_EXP:
            return _Value(self._use(args[0]), args[0].depth, role="exp")
        if op == ca.OP_ADD and {arg.role for arg in args} & {"exp"}:
            exp, one = sorted(args, key=lambda arg: arg.role != "exp")
            if one.constant == 1.0:
                return _Value(exp.text, exp.depth, role="1+exp")
        if op in (ca.OP_INV, ca.OP_DIV) and args[-1].role == "1+exp":
            gate = self._gate(args[-1])
            return gate if op == ca.OP_INV else self._line(k, "{0} * {1}", [args[0], gate])
        if op in BINARY:
            return self._line(k, f"{{0}} {BINARY[op]} {{1}}", args)
        if op in UNARY:
            return self._line(k, UNARY[op].replace("{two}", self.real.literal(2.0)), args)
        raise NotImplementedError(f"{self.function.name()}: CasADi operation {op} has no C form here")

    def _gate(self, below: _Value) -> _Value:
        """The inverse of 1 + exp(a): written as a, a gate of its depth from then on."""
        if below.gate is None:
            at = self.gates.get(below.depth, 0)
            self.gates[below.depth] = at + 1
            name = f"gate_{below.depth}[{at}]"
            self.lines[below.depth].append(f"    {name} = {below.text};")
            below.gate = _Value(name, below.depth + 1)
        return below.gate

    def _line(self, k: int, form: str, args: list[_Value]) -> _Value:
        depth = max(arg.depth for arg in args)
        text = form.format(*(self._use(arg) for arg in args))
        self.lines.setdefault(depth, []).append(f"    const real_t t{k} = {text};")
        return _Value(f"t{k}", depth)

    def _use(self, value: _Value) -> str:
        if value.role:
            raise NotImplementedError(f"{self.function.name()}: exp() outside a gate has no C form here")
        return value.text
