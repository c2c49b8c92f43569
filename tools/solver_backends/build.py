"""Compile the bench, and each backend as a shared library of its own."""

from __future__ import annotations

import subprocess
from pathlib import Path

import casadi as ca

from estimator_c.formulation.generate import generate
from estimator_c.formulation.real import DOUBLE, Real
from estimator_c.formulation.weights import load_weights
from tools.libest import ROOT, SETTINGS
from tools.solver_backends.model import write_model

HERE = Path(__file__).resolve().parent
TOOLS = HERE.parent
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")


class BuildError(Exception):
    """A backend cannot be built here; the message says why."""


def build_runner(folder: Path) -> Path:
    """bench_solver."""
    program = folder / "bench_solver"
    _gcc(["-O2", "-g1", *STRICT, f"-I{TOOLS}", str(TOOLS / "bench_solver.c"), "-o", str(program), "-ldl"])
    return program


def build_mhe(weights: Path, folder: Path, real: Real = DOUBLE) -> Path:
    """The estimator's own MHE, compiled as the product is (-O2), with every kernel there is for this type."""
    generated, base = folder / f"gen_{real.c_type}", ROOT / "estimator_c" / "src"
    library = folder / f"libmhe_{real.c_type}.so"
    written = generate(weights, SETTINGS, generated, real)
    sources = [p for p in written if p.suffix == ".c" and "envelope" not in p.name]
    sources += [*sorted(base.glob("mhe*.c")), *sorted((base / "solver").glob("*.c"))]
    sources.append(HERE / "mhe_backend.c")
    _gcc([
        "-O2", "-g1", "-fPIC", "-shared", "-fno-math-errno", "-Wall", "-Wextra", "-Werror",
        f"-I{base}", f"-I{base / 'solver'}", f"-I{generated}", f"-I{HERE}", *map(str, sources),
        "-o", str(library), "-lm",
    ])  # fmt: skip
    return library


def build_hpipm(weights: Path, folder: Path) -> Path:
    """SQP with HPIPM from the casadi wheel; model and derivatives generated from the same weights.

    Raises
    ------
    BuildError
        The wheel has no HPIPM, or its headers do not compile.
    """
    wheel = Path(str(ca.__file__)).parent
    for needed in ("libhpipm.so", "libblasfeo.so", "include/hpipm_d_ocp_qp_ipm.h"):
        if not (wheel / needed).exists():
            raise BuildError(f"the casadi wheel has no {needed}: install a casadi wheel of 3.6.7 or later from PyPI")
    library, generated = folder / "libhpipm_backend.so", folder / "gen_double"
    generate(weights, SETTINGS, generated)
    model = write_model(load_weights(weights), folder)
    objects = []
    for source, flags in ((model, ("-w",)), (HERE / "hpipm_qp.c", STRICT), (HERE / "hpipm_backend.c", STRICT)):
        objects.append(folder / f"{source.stem}.o")
        _gcc([
            "-O2", "-g1", "-fPIC", "-fno-math-errno", *flags, f"-I{folder}", f"-I{HERE}", f"-I{generated}",
            "-isystem", str(wheel / "include"), "-c", str(source), "-o", str(objects[-1]),
        ])  # fmt: skip
    _gcc([
        "-shared", *map(str, objects), "-o", str(library), f"-L{wheel}", "-l:libhpipm.so", "-l:libblasfeo.so",
        f"-Wl,-rpath,{wheel}", "-lm",
    ])  # fmt: skip
    return library


def _gcc(arguments: list[str]) -> None:
    done = subprocess.run(["gcc", "-std=c11", "-D_GNU_SOURCE", *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise BuildError(f"gcc failed: {done.stderr.strip() or 'no word'}")
