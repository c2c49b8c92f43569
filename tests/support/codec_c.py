"""The C codec and end-to-end check as a shared library for tests, generated and built into a folder of the test."""

import ctypes as ct
import subprocess
import sys
from pathlib import Path

from cantools.database.can.c_source import camel_to_snake_case as snake

from rt_runner.dbc import Dbc, MessageInfo

ROOT = Path(__file__).resolve().parents[2]
SRC = ROOT / "estimator_c" / "src"
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-D_GNU_SOURCE"]
UNDEFINED = ["-fsanitize=undefined", "-fno-sanitize-recover=undefined"]


def generate(out: Path) -> Path:
    """Run the code generator as the build does; returns ``out``."""
    command = [sys.executable, "-m", "rt_runner.codegen", "--out", str(out)]
    subprocess.run(command, cwd=ROOT, check=True)
    return out


def gcc(*arguments: str | Path) -> None:
    subprocess.run(["gcc", *map(str, arguments)], check=True, capture_output=True, text=True)


def _shim(m: MessageInfo) -> str:
    """Encode and decode of one message, as a program would write them, with an array of doubles."""
    name = f"drive_{snake(m.name)}"
    fields = [snake(s.name) for s in m.payload]
    put = "\n".join(f"    m.{f} = {name}_{f}_to_raw(v[{i}]);" for i, f in enumerate(fields))
    get = "\n".join(f"    v[{i}] = {name}_{f}_to_phys(m.{f});" for i, f in enumerate(fields))
    return f"""
int shim_encode_{m.name}(e2e_sender_t *sender, const double *v, uint8_t *frame)
{{
    struct {name}_t m;
    {name}_init(&m);
{put}
    return {name}_pack(frame, &m, 8) == 8 && e2e_protect(sender, frame, 8);
}}
int shim_decode_{m.name}(double *v, const uint8_t *frame)
{{
    struct {name}_t m;
    if ({name}_unpack(&m, frame, 8) != 0) {{
        return 0;
    }}
{get}
    return 1;
}}
"""


class Sender(ct.Structure):
    """e2e_sender_t"""

    _fields_ = (("data_id_list", ct.c_void_p), ("counter", ct.c_uint8))


class Receiver(ct.Structure):
    """e2e_receiver_t"""

    _fields_ = (
        ("data_id_list", ct.c_void_p), ("length", ct.c_uint8), ("max_delta", ct.c_uint8),
        ("last_counter", ct.c_uint8), ("status", ct.c_int), ("started", ct.c_bool),
        ("counts", ct.c_uint32 * 5), ("frames_lost", ct.c_uint32),
    )  # fmt: skip


class CCodec:
    """Builds and loads it; undefined behaviour aborts."""

    def __init__(self, dbc: Dbc, folder: Path) -> None:
        gen = generate(folder / "gen")
        declarations = '#include "drive_e2e.h"\n#include "e2e.h"\nsize_t shim_sizes(int which);\n'
        declarations += "".join(
            f"int shim_encode_{m.name}(e2e_sender_t *sender, const double *v, uint8_t *frame);\n"
            f"int shim_decode_{m.name}(double *v, const uint8_t *frame);\n"
            for m in dbc
        )
        sizes = "size_t shim_sizes(int which) { return which ? sizeof(e2e_receiver_t) : sizeof(e2e_sender_t); }\n"
        (folder / "shim.c").write_text(declarations + sizes + "".join(map(_shim, dbc)))
        include, common = ["-I", gen, "-I", SRC], ["-O1", "-g1", "-fPIC", *UNDEFINED]
        for source in (SRC / "e2e.c", gen / "drive_e2e.c", folder / "shim.c"):
            gcc(*STRICT, *common, *include, "-c", source, "-o", folder / f"{source.stem}.o")
        gcc("-std=c11", "-w", *common, *include, "-c", gen / "drive.c", "-o", folder / "drive.o")
        library = folder / "libcodec.so"
        gcc("-shared", *UNDEFINED, *folder.glob("*.o"), "-lm", "-o", library)
        self.lib = ct.CDLL(str(library))
        self.lib.shim_sizes.restype = ct.c_size_t
        self.lib.e2e_check.argtypes = [ct.c_void_p, ct.c_char_p, ct.c_size_t]
        assert (ct.sizeof(Sender), ct.sizeof(Receiver)) == (self.lib.shim_sizes(0), self.lib.shim_sizes(1))
        self._ids = {m.name: ct.create_string_buffer(m.data_id_list, 16) for m in dbc}

    def sender(self, message: MessageInfo, counter: int = 0) -> Sender:
        """A sender whose next frame carries ``counter + 1``."""
        return Sender(ct.cast(self._ids[message.name], ct.c_void_p), counter)

    def receiver(self, message: MessageInfo, max_delta: int) -> Receiver:
        """A fresh receiver."""
        receiver = Receiver()
        self.lib.e2e_receiver_init.restype = ct.c_bool
        assert self.lib.e2e_receiver_init(ct.byref(receiver), self._ids[message.name], message.length, max_delta)
        return receiver

    def encode(self, message: MessageInfo, values: dict[str, float], sender: Sender) -> bytes:
        """Frame of physical values (NaN: not available)."""
        flat = (ct.c_double * len(message.payload))(*(values[s.name] for s in message.payload))
        frame = ct.create_string_buffer(8)
        assert self.lib[f"shim_encode_{message.name}"](ct.byref(sender), flat, frame) == 1
        return frame.raw

    def decode(self, message: MessageInfo, frame: bytes) -> dict[str, float]:
        """Physical values of a frame's payload, unchecked (NaN: not available)."""
        flat = (ct.c_double * len(message.payload))()
        assert self.lib[f"shim_decode_{message.name}"](flat, frame) == 1
        return {s.name: v for s, v in zip(message.payload, flat, strict=True)}

    def check(self, receiver: Receiver, frame: bytes) -> int:
        """e2e_check."""
        return self.lib.e2e_check(ct.byref(receiver), frame, len(frame))
