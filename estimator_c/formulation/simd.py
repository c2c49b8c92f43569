"""The net's step and its adjoint as vector code: cells side by side, one vector of the machine after the other.

Written from the weights, not from CasADi's scalar instructions: a gate of eight cells is one row of eight numbers, a
column of the weight matrix times one input. The C is straight-line on the vec_... functions of src/simd/vec_*.h, for
any width. Scaling of inputs and outputs is folded in as in net.py, and so is the factor of each gate's exponential: a
sigmoid is 1/(1 + 2^a) with a = -z/ln 2, and tanh z is 2/(1 + 2^a) - 1 with a = -2 z/ln 2.

Tests hold all of it against numpy and CasADi to 1e-12.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .real import DOUBLE
from .weights import CELLS, NetWeights

Array = NDArray[np.float64]
SIGMOID, TANH, PLAIN = -1.0 / math.log(2.0), -2.0 / math.log(2.0), 1.0
PAD = 8  # cells are padded to a multiple of the widest vector


@dataclass(frozen=True)
class Isa:
    """An instruction set: its name, the doubles in a vector, and the header that has its vec_... functions."""

    name: str
    width: int

    @property
    def header(self) -> str:
        return f"simd/vec_{self.name}.h"


AVX2, AVX512 = Isa("avx2", 4), Isa("avx512", 8)
ISAS = (AVX512, AVX2)  # best first


@dataclass
class _Text:
    """C lines and the tables they refer to."""

    tables: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)

    def table(self, name: str, rows: Array, note: str) -> None:
        """A constant table (rows, cells), each row padded with zeros to whole vectors."""
        rows = np.atleast_2d(rows)
        padded = np.zeros((len(rows), _padded(rows.shape[1])))
        padded[:, : rows.shape[1]] = rows
        body = ",\n".join("    {" + ", ".join(map(_number, row)) + "}" for row in padded)
        head = f"static const _Alignas(64) real_t {name}[{padded.shape[0]}][{padded.shape[1]}]"
        self.tables.append(f"/* {note} */\n{head} = {{\n{body}}};\n")

    def let(self, name: str, value: str) -> None:
        self.lines.append(f"    const vec_t {name} = {value};")

    def say(self, line: str) -> None:
        self.lines.append(f"    {line}")

    def take(self) -> str:
        text, self.lines = "\n".join(self.lines), []
        return text


def kernel_source(weights: NetWeights, isa: Isa, banner: str, arguments: Callable[[str], str]) -> str:
    """thermal_net_<isa>.c: forward, adjoint and slope of the net, and the net_kernel_t that names them.

    arguments(function) gives the arguments of each in parentheses.
    """
    return _Kernel(weights, isa).source(banner, arguments)


class _Kernel:
    def __init__(self, weights: NetWeights, isa: Isa) -> None:
        self.net, self.isa, self.out = weights, isa, _Text()
        self.h = weights.hidden
        self.lstm = weights.cell == "lstm"
        self.gates = CELLS[weights.cell]
        self.chunks = -(-self.h // isa.width)
        self.tape_gates = 5 if self.lstm else 4
        self.names = "ifgot" if self.lstm else "rznq"  # of the tape; t: tanh of c_next
        self._write_tables()

    # ---- tables ---------------------------------------------------------------------------------------------
    def _write_tables(self) -> None:
        net, h, out = self.net, self.h, self.out
        for k, layer in enumerate(net.stack):
            w_in, b = layer.w_u, layer.b
            if k == 0:
                w_in = layer.w_u / net.in_scale
                b = layer.b - w_in @ net.in_offset
            scale = {"i": SIGMOID, "f": SIGMOID, "g": TANH, "o": SIGMOID, "r": SIGMOID, "z": SIGMOID, "n": TANH}
            rows = [scale[g] for g in self.gates]
            bias = np.stack([s * b[g * h : (g + 1) * h] for g, s in enumerate(rows)])
            recurrent_scale = list(rows)
            if not self.lstm:
                assert layer.b_h is not None, "a GRU layer has it, or it was not loaded"
                recurrent_scale[2] = PLAIN  # W_hn h + b_hn is recorded as it is
                bias[:2] += np.stack([s * layer.b_h[g * h : (g + 1) * h] for g, s in enumerate(rows[:2])])
                bias = np.vstack([bias, layer.b_h[2 * h :]])
            columns = [s * w_in[g * h : (g + 1) * h].T for g, s in enumerate(rows)]
            recurrent = [s * layer.w_h[g * h : (g + 1) * h].T for g, s in enumerate(recurrent_scale)]
            of = f"layer {k}"
            out.table(f"bias_{k}", bias, f"{of}: a row per gate")
            out.table(f"in_{k}", np.vstack(columns), f"{of}: gate by gate, a row per input")
            out.table(f"rec_{k}", np.vstack(recurrent), f"{of}: gate by gate, a row per h")
            out.table(f"back_{k}", layer.w_h, f"{of}: gate by gate, a row per cell: its weights on h")
            if k > 0:
                out.table(f"down_{k}", layer.w_u, f"{of}: gate by gate, a row per cell: its weights on the layer below")
        w_in = net.stack[0].w_u / net.in_scale
        theta = np.vstack([w_in[:, 2 + t].reshape(len(self.gates), h) for t in range(2)])
        out.table("theta_w", theta, "winding, then rotor: a row per gate")
        out.table("out_w", net.out_scale[:, None] * net.w_y, "a row per rate")

    # ---- pieces ---------------------------------------------------------------------------------------------
    def _count(self, chunk: int) -> int:
        """Cells in a chunk: the last one may be short."""
        return min(self.isa.width, self.h - chunk * self.isa.width)

    def _at(self, base: int, chunk: int) -> int:
        return base + chunk * self.isa.width

    def _load(self, array: str, base: int, chunk: int) -> str:
        return f"vec_load_part(&{array}[{self._at(base, chunk)}], {self._count(chunk)})"

    def _store(self, array: str, base: int, chunk: int, value: str) -> None:
        self.out.say(f"vec_store_part(&{array}[{self._at(base, chunk)}], {value}, {self._count(chunk)});")

    def _weight(self, table: str, row: int, chunk: int) -> str:
        return f"vec_load(&{table}[{row}][{chunk * self.isa.width}])"

    def _c(self, layer: int) -> int:
        return layer * self.h

    def _h(self, layer: int) -> int:
        return self.net.memory_c + layer * self.h

    def _sum(self, name: str, first: str | None, terms: list[tuple[str, str]], chains: int) -> None:
        """name = first + sum of products, in `chains` sums side by side: a single one would wait for itself."""
        chains = max(1, min(chains, len(terms)))
        sums: list[str | None] = [first, *([None] * (chains - 1))]
        for k, (a, b) in enumerate(terms):
            at, new = k % chains, f"{name}_{k}"
            old = sums[at]
            self.out.let(new, f"vec_mul({a}, {b})" if old is None else f"vec_fma({a}, {b}, {old})")
            sums[at] = new
        parts = [part for part in sums if part is not None]
        while len(parts) > 1:
            parts = [f"vec_add({a}, {b})" for a, b in zip(parts[::2], parts[1::2], strict=False)] + (
                [parts[-1]] if len(parts) % 2 else []
            )
        self.out.let(name, parts[0])

    # ---- forward --------------------------------------------------------------------------------------------
    def _forward(self) -> str:
        out, net = self.out, self.net
        for k in range(2):
            out.let(f"u_{k}", f"vec_all(u[{k}])")
            out.let(f"theta_{k}", f"vec_all(theta[{k}])")
        inputs = ["u_0", "u_1", "theta_0", "theta_1"]
        for layer in range(len(net.stack)):
            for chunk in range(self.chunks):
                self._cells(layer, chunk, inputs)
            if layer + 1 < len(net.stack):
                out.say(f"_Alignas(64) real_t below_{layer}[{_padded(self.h)}];")
                for chunk in range(self.chunks):
                    out.say(f"vec_store(&below_{layer}[{chunk * self.isa.width}], h_{layer}_{chunk});")
                inputs = [f"vec_all(below_{layer}[{j}])" for j in range(self.h)]
        for layer in range(len(net.stack)):  # only now: memory_next may be memory
            for chunk in range(self.chunks):
                if self.lstm:
                    self._store("memory_next", self._c(layer), chunk, f"c_{layer}_{chunk}")
                self._store("memory_next", self._h(layer), chunk, f"h_{layer}_{chunk}")
        offset = net.out_offset + net.out_scale * net.b_y
        top = len(net.stack) - 1
        for t in range(2):
            terms = [(f"h_{top}_{chunk}", self._weight("out_w", t, chunk)) for chunk in range(self.chunks)]
            self._sum(f"rate_{t}", None, terms, 1)
            out.say(f"rate[{t}] = vec_sum(rate_{t}) + {_number(offset[t])};")
        return out.take()

    def _cells(self, layer: int, chunk: int, inputs: list[str]) -> None:
        out, tag = self.out, f"{layer}_{chunk}"
        out.say(f"/* layer {layer}, cells {chunk * self.isa.width}.. */")
        own = [f"vec_all(memory[{self._h(layer) + j}])" for j in range(self.h)]
        for g, gate in enumerate(self.gates):
            fed = [(x, self._weight(f"in_{layer}", g * len(inputs) + j, chunk)) for j, x in enumerate(inputs)]
            back = [(x, self._weight(f"rec_{layer}", g * self.h + j, chunk)) for j, x in enumerate(own)]
            self._sum(f"x_{gate}_{tag}", self._weight(f"bias_{layer}", g, chunk), fed, 1 if layer == 0 else 2)
            if gate == "n":
                self._sum(f"q_{tag}", self._weight(f"bias_{layer}", 3, chunk), back, 2)
            else:
                self._sum(f"a_{gate}_{tag}", f"x_{gate}_{tag}", back, 2)
        for gate in "ifo" if self.lstm else "rz":
            out.let(f"{gate}_{tag}", f"vec_gate(a_{gate}_{tag})")
        if self.lstm:  # written so that as little as can be waits for the next: the tanh's 2 s - 1 melts into products
            tanh = _number(TANH)
            c = self._load("memory", self._c(layer), chunk)
            out.let(f"s_g_{tag}", f"vec_gate(a_g_{tag})")
            out.let(f"g_{tag}", f"vec_fma(vec_all(2.0), s_g_{tag}, vec_all(-1.0))")
            out.let(f"ig_{tag}", f"vec_fma(vec_add(i_{tag}, i_{tag}), s_g_{tag}, vec_neg(i_{tag}))")
            out.let(f"c_{tag}", f"vec_fma(f_{tag}, {c}, ig_{tag})")
            scaled_c, scaled_ig = f"vec_mul({c}, vec_all({tanh}))", f"vec_mul(ig_{tag}, vec_all({tanh}))"
            out.let(f"a_t_{tag}", f"vec_fma(f_{tag}, {scaled_c}, {scaled_ig})")
            out.let(f"s_t_{tag}", f"vec_gate(a_t_{tag})")
            out.let(f"t_{tag}", f"vec_fma(vec_all(2.0), s_t_{tag}, vec_all(-1.0))")
            out.let(f"h_{tag}", f"vec_fma(vec_add(o_{tag}, o_{tag}), s_t_{tag}, vec_neg(o_{tag}))")
        else:
            out.let(f"a_n_{tag}", f"vec_fma(vec_mul(r_{tag}, q_{tag}), vec_all({_number(TANH)}), x_n_{tag})")
            out.let(f"n_{tag}", f"vec_fma(vec_all(2.0), vec_gate(a_n_{tag}), vec_all(-1.0))")
            old = self._load("memory", self._h(layer), chunk)
            out.let(f"h_{tag}", f"vec_fma(z_{tag}, vec_sub({old}, n_{tag}), n_{tag})")
        for g, gate in enumerate(self.names):
            self._store("tape", (layer * self.tape_gates + g) * self.h, chunk, f"{gate}_{tag}")

    # ---- backward -------------------------------------------------------------------------------------------
    def _adjoint(self) -> str:
        self._pull_back({t: f"rate_bar[{t}]" for t in range(2)}, with_memory=True)
        for t in range(2):
            self.out.say(f"theta_bar[{t}] = vec_sum(theta_{t});")
        return self.out.take()

    def _slope(self) -> str:
        """Two ways back with a unit rate each, in scopes of their own."""
        for t in range(2):
            self.out.say("{")
            self._pull_back({t: ""}, with_memory=False)
            self.out.say(f"slope[{t}] = vec_sum(theta_{t});")
            self.out.say("}")
        return self.out.take()

    def _pull_back(self, seeds: dict[int, str], with_memory: bool) -> None:
        """From rate_bar (all, or one that is 1) and memory_next_bar to theta_{t} and, stored, memory_bar."""
        out, top = self.out, len(self.net.stack) - 1
        for chunk in range(self.chunks):
            weights = {t: self._weight("out_w", t, chunk) for t in seeds}
            if len(seeds) == 1:
                out.let(f"above_{top}_{chunk}", next(iter(weights.values())))
            else:
                terms = [(f"vec_all({seed})", weights[t]) for t, seed in seeds.items()]
                self._sum(f"above_{top}_{chunk}", None, terms, 1)
        stores: list[tuple[int, int, str]] = []
        for layer in range(top, -1, -1):
            for chunk in range(self.chunks):
                self._gates_back(layer, chunk, with_memory)
            if with_memory or layer > 0:
                self._spill(layer, with_memory)
            for chunk in range(self.chunks):
                tag = f"{layer}_{chunk}"
                if with_memory:
                    first = None if self.lstm else f"kept_{tag}"
                    kind = "z" if self.lstm else "hz"
                    self._times_rows(f"h_bar_out_{tag}", first, kind, f"back_{layer}", layer, chunk)
                    stores.append((self._h(layer), chunk, f"h_bar_out_{tag}"))
                    if self.lstm:
                        stores.append((self._c(layer), chunk, f"c_bar_out_{tag}"))
                if layer > 0:
                    self._times_rows(f"above_{layer - 1}_{chunk}", None, "z", f"down_{layer}", layer, chunk)
        for base, chunk, value in stores:  # only now: memory_bar may be memory_next_bar
            self._store("memory_bar", base, chunk, value)
        for t in seeds:
            terms = [
                (f"z_{gate}_0_{chunk}", self._weight("theta_w", t * len(self.gates) + g, chunk))
                for chunk in range(self.chunks)
                for g, gate in enumerate(self.gates)
            ]
            self._sum(f"theta_{t}", None, terms, 2)

    def _gates_back(self, layer: int, chunk: int, with_memory: bool) -> None:
        """z_<gate>: what comes back to the argument of each gate; for a GRU also hz_n, what comes back to W_hn h."""
        out, tag = self.out, f"{layer}_{chunk}"
        for g, gate in enumerate(self.names):
            out.let(f"{gate}_{tag}", self._load("tape", (layer * self.tape_gates + g) * self.h, chunk))
        h_bar = f"above_{tag}"
        if with_memory:
            out.let(f"h_bar_{tag}", f"vec_add({h_bar}, {self._load('memory_next_bar', self._h(layer), chunk)})")
            h_bar = f"h_bar_{tag}"
        v = {gate: f"{gate}_{tag}" for gate in self.names}

        def rest(gate: str) -> str:  # derivative of a sigmoid: s (1 - s)
            return f"vec_sub({v[gate]}, vec_mul({v[gate]}, {v[gate]}))"

        if self.lstm:
            out.let(f"by_h_{tag}", f"vec_fnma(vec_mul({v['o']}, {v['t']}), {v['t']}, {v['o']})")
            c_bar = self._load("memory_next_bar", self._c(layer), chunk) if with_memory else ""
            product = f"vec_fma({h_bar}, by_h_{tag}, {c_bar})" if with_memory else f"vec_mul({h_bar}, by_h_{tag})"
            out.let(f"c_sum_{tag}", product)
            c = self._load("memory", self._c(layer), chunk)
            out.let(f"z_i_{tag}", f"vec_mul(c_sum_{tag}, vec_mul({v['g']}, {rest('i')}))")
            out.let(f"z_f_{tag}", f"vec_mul(c_sum_{tag}, vec_mul({c}, {rest('f')}))")
            out.let(f"z_g_{tag}", f"vec_mul(c_sum_{tag}, vec_fnma(vec_mul({v['i']}, {v['g']}), {v['g']}, {v['i']}))")
            out.let(f"z_o_{tag}", f"vec_mul({h_bar}, vec_mul({v['t']}, {rest('o')}))")
            if with_memory:
                out.let(f"c_bar_out_{tag}", f"vec_mul(c_sum_{tag}, {v['f']})")
            return
        h = self._load("memory", self._h(layer), chunk)
        slope = f"vec_fnma({v['n']}, {v['n']}, vec_all(1.0))"
        out.let(f"z_n_{tag}", f"vec_mul({h_bar}, vec_mul(vec_sub(vec_all(1.0), {v['z']}), {slope}))")
        out.let(f"z_r_{tag}", f"vec_mul(z_n_{tag}, vec_mul({v['q']}, {rest('r')}))")
        out.let(f"z_z_{tag}", f"vec_mul({h_bar}, vec_mul(vec_sub({h}, {v['n']}), {rest('z')}))")
        if with_memory:
            out.let(f"hz_n_{tag}", f"vec_mul(z_n_{tag}, {v['r']})")
            out.let(f"kept_{tag}", f"vec_mul({h_bar}, {v['z']})")

    def _spill(self, layer: int, with_memory: bool) -> None:
        """Write the gates' bars to memory: the products need them one by one."""
        rows = [("z", gate) for gate in self.gates] + ([] if self.lstm or not with_memory else [("hz", "n")])
        for kind, gate in rows:
            self.out.say(f"_Alignas(64) real_t {kind}_{gate}_{layer}[{_padded(self.h)}];")
            for chunk in range(self.chunks):
                at = chunk * self.isa.width
                self.out.say(f"vec_store(&{kind}_{gate}_{layer}[{at}], {kind}_{gate}_{layer}_{chunk});")

    def _times_rows(self, name: str, first: str | None, kind: str, table: str, layer: int, chunk: int) -> None:
        """name = first + (gates' bars) . (rows of the table), the chunk's columns."""
        terms = []
        for j in range(self.h):
            for g, gate in enumerate(self.gates):
                source = "hz" if kind == "hz" and gate == "n" else "z"
                terms.append((f"vec_all({source}_{gate}_{layer}[{j}])", self._weight(table, g * self.h + j, chunk)))
        self._sum(name, first, terms, 8)

    # ---- the file -------------------------------------------------------------------------------------------
    def source(self, banner: str, arguments: Callable[[str], str]) -> str:
        name = self.isa.name
        functions = {"forward": self._forward(), "adjoint": self._adjoint(), "slope": self._slope()}
        bodies = "\n".join(f"static void {head}{arguments(head)}\n{{\n{text}\n}}\n" for head, text in functions.items())
        tables = "\n".join(self.out.tables)
        return (
            f'{banner}#include "{self.isa.header}" /* first: it sets the instruction set */\n\n'
            f'#include "thermal_net.h"\n\n{tables}\n{bodies}\n'
            f"const net_kernel_t net_{name} = {{\n"
            f'    .name = "{name}",\n    .available = vec_available,\n    .forward = forward,\n'
            f"    .adjoint = adjoint,\n    .slope = slope,\n}};\n"
        )


def _padded(cells: int) -> int:
    return -(-cells // PAD) * PAD


def _number(value: float) -> str:
    return DOUBLE.literal(value)
