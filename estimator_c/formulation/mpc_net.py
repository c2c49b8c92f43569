"""The net's tables and kernels for the MPC's derivatives, and its settings, as C:

    python -m estimator_c.formulation.mpc_net --weights W --settings DIR --out DIR

Writes ocp_net.{h,c} (the net's weights by gate and cell, scaling folded in), ocp_net_<kernel>.c (the bulk work of
src/simd/ocp_kernel_body.h on each family of processors), ocp_net_select.c, and mpc_settings.{h,c}. The step of the net
itself is the one of thermal_net.h. The same inputs give the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import FormulationError
from .generate import BANNER
from .mpc_settings import load_mpc_settings, load_vehicle, settings_header, settings_source
from .real import DOUBLE
from .simd import ISAS, PAD, Isa
from .weights import NetWeights, load_weights

PORTABLE = Isa("portable", 1)


def generate_mpc(weights_path: Path, settings_folder: Path, out: Path, isas: Sequence[Isa] = ISAS) -> list[Path]:
    """Write all generated files into `out` and return their paths; unchanged files keep their time stamp."""
    weights = load_weights(weights_path)
    vehicle, settings = load_vehicle(settings_folder), load_mpc_settings(settings_folder)
    kernels = (*isas, PORTABLE)
    files = {
        "mpc_settings.h": settings_header(BANNER, len(settings)),
        "mpc_settings.c": settings_source(BANNER, vehicle, settings),
        "ocp_net.h": net_header(weights),
        "ocp_net.c": net_source(weights),
        "ocp_net_select.c": select_source(kernels),
        **{f"ocp_net_{isa.name}.c": kernel_source(isa) for isa in kernels},
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        path = out / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    return [out / name for name in files]


def supported(weights: NetWeights) -> bool:
    """Whether the MPC knows the derivatives of such a net: one layer of LSTM cells, a multiple of eight."""
    return weights.cell == "lstm" and len(weights.stack) == 1 and weights.hidden % PAD == 0


def net_header(weights: NetWeights) -> str:
    """ocp_net.h."""
    cells = weights.hidden if supported(weights) else PAD
    return f"""{BANNER}#ifndef OCP_NET_H
#define OCP_NET_H

#include <stdbool.h>

#include "thermal_net.h"

#define OCP_SUPPORTED {"true" if supported(weights) else "false"} /* one layer of LSTM cells, a multiple of {PAD} */
#define OCP_CELLS {cells}
#define OCP_PAD {cells}
#define OCP_BACK {cells + PAD} /* h of all cells, then speed, torque, winding, rotor, then nothing */

/* From the arguments of gate g (i, f, g, o) of cell j, row g OCP_PAD + j, to h and the inputs. */
extern const double ocp_back[4 * OCP_PAD][OCP_BACK];

/* From the rates, degC/s, to the new h. */
extern const double ocp_out[2][OCP_PAD];

#endif
"""


def net_source(weights: NetWeights) -> str:
    """ocp_net.c."""
    cells = weights.hidden if supported(weights) else PAD
    back, out = np.zeros((4 * cells, cells + PAD)), np.zeros((2, cells))
    if supported(weights):
        layer = weights.stack[0]
        back[:, :cells] = layer.w_h
        back[:, cells : cells + 4] = layer.w_u / weights.in_scale
        out[:] = weights.out_scale[:, None] * weights.w_y
    return f"""{BANNER}#include "ocp_net.h"

_Alignas(64) const double ocp_back[4 * OCP_PAD][OCP_BACK] = {{
{_rows(back)}
}};

_Alignas(64) const double ocp_out[2][OCP_PAD] = {{
{_rows(out)}
}};
"""


def _rows(table: NDArray[np.float64]) -> str:
    return "\n".join(f"    {{{_list(row)}}}," for row in table)


def _list(values: Iterable[float]) -> str:
    return ", ".join(DOUBLE.literal(float(value)) for value in values)


def kernel_source(isa: Isa) -> str:
    """ocp_net_<kernel>.c."""
    return f"""{BANNER}#include "{isa.header}" /* first: it sets the instruction set */

#define VEC_WIDTH {isa.width}
#define OCP_KERNEL ocp_kernel_{isa.name}
#define OCP_KERNEL_NAME "{isa.name}"

#include "ocp_kernel.h"

extern const ocp_kernel_t OCP_KERNEL;

#include "simd/ocp_kernel_body.h"
"""


def select_source(kernels: Sequence[Isa]) -> str:
    """ocp_net_select.c."""
    names = ", ".join(f"&ocp_kernel_{isa.name}" for isa in kernels)
    declared = ", ".join(f"ocp_kernel_{isa.name}" for isa in kernels)
    return f"""{BANNER}#include "ocp_kernel.h"

#include <stddef.h>
#include <string.h>

extern const ocp_kernel_t {declared};

static const ocp_kernel_t *const kernels[] = {{{names}}}; /* best first */

const ocp_kernel_t *ocp_kernel = &ocp_kernel_portable;

const char *ocp_select(const char *name)
{{
    for (size_t k = 0; k < sizeof kernels / sizeof kernels[0]; k++) {{
        const bool meant = name == NULL || strcmp(name, kernels[k]->name) == 0;
        if (meant && kernels[k]->available()) {{
            ocp_kernel = kernels[k];
            return ocp_kernel->name;
        }}
    }}
    return NULL;
}}

/* Before main(), or when the library is loaded. */
__attribute__((constructor)) static void select_best(void)
{{
    (void)ocp_select(NULL);
}}
"""


def main(argv: list[str] | None = None) -> int:
    """Command line; errors are one line on stderr and exit code 1."""
    parser = argparse.ArgumentParser(prog="estimator_c.formulation.mpc_net", description="weights and settings to C")
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--settings", type=Path, required=True, help="folder with vehicle.toml and the MPC's settings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--portable", action="store_true", help="plain C alone, no kernels for vector machines")
    args = parser.parse_args(argv)
    try:
        generate_mpc(args.weights, args.settings, args.out, () if args.portable else ISAS)
    except FormulationError as err:
        print(f"mpc_net: {err}", file=sys.stderr)
        return 1
    except OSError as err:
        print(f"mpc_net: {err.filename}: {err.strerror}; give a folder that can be written", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
