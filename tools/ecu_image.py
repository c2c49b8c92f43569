"""The MHE's step as an image for a Cortex-M7, and as a program of this machine from the same sources and number type.

Float only: single precision is all that the FPU of the smaller Cortex-M7 computes (`-mfpu=fpv5-sp-d16`), so arithmetic
in double would be a call into the compiler's library, and is refused. No C library is linked.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from estimator_c.formulation.generate import generate
from estimator_c.formulation.real import REALS

ROOT = Path(__file__).resolve().parents[1]
BASE = ROOT / "estimator_c"
ECU = BASE / "ecu"
SETTINGS = BASE / "settings"
STEP = (
    BASE / "src" / "mhe.c",
    BASE / "src" / "mhe_loss.c",
    *sorted((BASE / "src" / "solver").glob("*.c")),
)  # and the generated net: what is measured
BENCH = ("replay", "an500_port", "startup", "memory")
ECU_FLAGS = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-sp-d16")
OPTIMISE = "-Os"  # fewer instructions and less flash than -O2 here
PACKAGES = ("gcc-arm-none-eabi", "qemu-system-arm")
TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-nm", "arm-none-eabi-size", "qemu-system-arm")

# Same arithmetic on both machines: no fused multiply-add, and no reordering (no -O does any).
FLAGS = (
    "-std=c11", "-g1", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections",
    "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror",
)  # fmt: skip

# mhe_init() converts the settings, which are double; strcmp() is in functions that nobody calls here, else the image
# would not link. Arithmetic in double, or any other call, is a defect.
MAY_CALL = {"memcpy", "memset", "strcmp", "__aeabi_d2f", "__aeabi_f2d"}


class ToolError(Exception):
    """A tool is absent or refused: what, and what to do."""


@dataclass(frozen=True)
class Image:
    """The programs, and what the linker says of the ECU's.

    elf: for the ECU; host: the same for this machine; double: the same in double. In bytes: flash, all in the flash
    region, start-up code included; step_flash, code and tables of the step alone; ram_static, data and bss in the RAM
    region. compiled: optimisation flags. frames: stack of each function of the step, as the compiler says.
    """

    elf: Path
    host: Path
    double: Path
    flash: int
    step_flash: int
    ram_static: int
    frames: dict[str, int]
    compiled: str


def missing_tools() -> list[str]:
    """Tools of this bench that are not installed."""
    return [tool for tool in TOOLS if shutil.which(tool) is None]


def build_image(weights: Path, folder: Path, flags: tuple[str, ...] = (OPTIMISE,)) -> Image:
    """Generate the C of `weights` and build the programs into `folder`; `flags` are the ECU's.

    Raises
    ------
    ToolError
        A tool is absent, the code does not compile, or the step calls what no ECU has.
    """
    if absent := missing_tools():
        raise ToolError(f"{', '.join(absent)} not found: run tools/apt-install {' '.join(PACKAGES)}")
    step = _sources(weights, folder, "float")
    target = [
        "arm-none-eabi-gcc",
        *ECU_FLAGS,
        *_flags(folder, "float"),
        *flags,
        f"-I{ECU / 'include'}",
        "-fstack-usage",
    ]
    measured = _compile(target, step, folder / "ecu")
    for item in measured:
        _refuse_calls(item)
    bench = _compile(target, [ECU / f"{name}.c" for name in BENCH], folder / "ecu")
    elf = folder / "ecu.elf"
    _run([
        "arm-none-eabi-gcc", *ECU_FLAGS, "-nostdlib", "-Wl,--gc-sections,--fatal-warnings,--no-warn-rwx-segments",
        f"-Wl,-Map={folder / 'ecu.map'}", "-T", str(ECU / "an500.ld"), *map(str, measured + bench), "-lgcc",
        "-o", str(elf),
    ])  # fmt: skip
    symbols = _symbols(elf)
    return Image(
        elf=elf,
        host=_host(step, folder, "float"),
        double=_host(_sources(weights, folder, "double"), folder, "double"),
        flash=symbols["flash_used"],
        step_flash=_step_flash(folder / "ecu.map", measured),
        ram_static=symbols["ram_static"],
        frames=_frames(measured),
        compiled=" ".join(flags),
    )


def _sources(weights: Path, folder: Path, real: str) -> list[Path]:
    generate(weights, SETTINGS, folder / real, REALS[real])
    return [*STEP, *sorted((folder / real).glob("thermal_net*.c"))]


def _flags(folder: Path, real: str) -> list[str]:
    include = [
        BASE / "src",
        BASE / "src" / "solver",
        folder / real,
        ROOT / "tools" / "solver_backends",
        ECU,
    ]
    return [*FLAGS, *(f"-I{path}" for path in include)]


def _host(step: list[Path], folder: Path, real: str) -> Path:
    command = ["gcc", *_flags(folder, real), "-O2"]
    objects = _compile(command, [*step, ECU / "replay.c", ECU / "host_port.c"], folder / f"host_{real}")
    program = folder / f"replay_{real}"
    _run(["gcc", *map(str, objects), "-o", str(program)])
    return program


def _compile(command: list[str], sources: list[Path], folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    objects = [folder / f"{source.stem}.o" for source in sources]
    for source, target in zip(sources, objects, strict=True):
        # A compiler may turn the loops of memcpy() into a call of memcpy().
        extra = ["-fno-tree-loop-distribute-patterns"] if source.name == "memory.c" else []
        _run([*command, *extra, "-c", str(source), "-o", str(target)])
    return objects


def _run(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise ToolError(f"{' '.join(command)}\n{done.stderr.strip()}")
    return done.stdout


def _refuse_calls(item: Path) -> None:
    """No library function and no double arithmetic in an object of the step."""
    undefined = _run(["arm-none-eabi-nm", "--undefined-only", "--format=posix", str(item)])
    calls = {line.split()[0] for line in undefined.splitlines() if line.strip()}
    allowed = re.compile(r"(net|mhe|box_qp|tridiag)_\w+")
    if foreign := sorted(name for name in calls - MAY_CALL if not allowed.fullmatch(name)):
        raise ToolError(f"{item.name}: the step calls {', '.join(foreign)}; keep it to float and its own functions")


def _symbols(elf: Path) -> dict[str, int]:
    lines = _run(["arm-none-eabi-nm", "--format=posix", str(elf)]).splitlines()
    return {words[0]: int(words[2], 16) for words in map(str.split, lines) if len(words) >= 3}


def _step_flash(link_map: Path, measured: list[Path]) -> int:
    """Bytes of the step's own objects in flash, from the linker's map (only what it kept)."""
    placed = link_map.read_text(encoding="utf-8").split("Linker script and memory map", 1)[1]
    total = 0
    for item in measured:
        entry = re.compile(rf"\.(?:text|rodata)\S*\s+0x[0-9a-f]+\s+0x([0-9a-f]+)\s+{re.escape(str(item))}\b")
        total += sum(int(size, 16) for size in entry.findall(placed))
    return total


def _frames(measured: list[Path]) -> dict[str, int]:
    """Function -> bytes of stack, from the compiler's .su files."""
    lines = [line for item in measured for line in item.with_suffix(".su").read_text(encoding="utf-8").splitlines()]
    return {place.rsplit(":", 1)[-1]: int(size) for place, size, _ in (line.split("\t") for line in lines)}
